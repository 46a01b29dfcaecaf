"""Read ranges from S3 with obstore, if it is installed and usable.

Its Rust client takes less time per request than s3fs. It does not read ``~/.aws``, and hangs in a
process that was forked after using it. If obstore cannot be used, s3fs reads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import timedelta
from functools import cache, lru_cache
from importlib.util import find_spec
from typing import Any

ReadRange = Callable[[str, int, int], bytes]
"""Function that reads a key from a start offset up to, without, an end offset."""

_forked_from_user = False

_CREDENTIALS = "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN"


def range_reader(bucket: str) -> ReadRange | None:
    """Return a reader of ranges of a bucket's objects; None if s3fs has to read them.

    Credentials must be in ``AWS_ACCESS_KEY_ID`` and ``AWS_SECRET_ACCESS_KEY``, the region or
    endpoint in ``AWS_REGION``, ``AWS_DEFAULT_REGION``, ``AWS_ENDPOINT_URL`` or
    ``AWS_ENDPOINT_URL_S3``. ``AWS_PROFILE`` or ``SLATPREP_OBSTORE=no`` turns it off. The reader
    raises FileNotFoundError, PermissionError or OSError.
    """
    credentials = tuple(map(os.environ.get, _CREDENTIALS))
    known = all(credentials[:2])
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    allowed = os.environ.get("SLATPREP_OBSTORE") != "no" and "AWS_PROFILE" not in os.environ
    if not (allowed and known and (region or endpoint)) or _forked_from_user or not _available():
        return None
    # A store keeps the credentials with which it was opened; they may be renewed meanwhile.
    return _reader(bucket, region or "us-east-1", endpoint or "", credentials, os.getpid())


@cache
def _available() -> bool:
    import fsspec.config

    # Only s3fs understands a user's settings of fsspec for S3.
    return find_spec("obstore") is not None and not fsspec.config.conf.get("s3")


@lru_cache(maxsize=64)
def _reader(
    bucket: str, region: str, endpoint: str, _credentials: tuple[str | None, ...], _process: int
) -> ReadRange:
    from obstore import get_range
    from obstore.exceptions import BaseError, NotFoundError, PermissionDeniedError
    from obstore.store import S3Store

    options: dict[str, Any] = {"endpoint": endpoint} if endpoint else {}
    store = S3Store(
        bucket,
        region=region,
        client_options={"allow_http": endpoint.startswith("http://")},
        retry_config={"max_retries": 4, "retry_timeout": timedelta(seconds=60)},
        **options,
    )
    os.register_at_fork(after_in_child=_forbid)

    def read(key: str, start: int, end: int) -> bytes:
        try:
            return bytes(get_range(store, key, start=start, end=end))
        except (NotFoundError, FileNotFoundError) as error:
            raise FileNotFoundError(*error.args) from None
        except PermissionDeniedError as error:
            raise PermissionError(*error.args) from None
        except BaseError as error:
            raise OSError(*error.args) from None

    return read


def _forbid() -> None:
    global _forked_from_user
    _forked_from_user = True

"""Ranged reads from S3 by obstore, where it is installed and can serve.

Its client in Rust takes less time a request than s3fs. It does not read ``~/.aws``, and hangs in a
process forked from one that has used it; there, and without it, s3fs reads.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from datetime import timedelta
from functools import cache
from importlib.util import find_spec
from typing import Any

ReadRange = Callable[[str, int, int], bytes]
"""Reads a key from one offset up to, without, another."""

_forked_from_user = False


def range_reader(bucket: str) -> ReadRange | None:
    """Return what reads ranges of a bucket's objects; None where s3fs has to.

    Credentials have to be in ``AWS_ACCESS_KEY_ID`` and ``AWS_SECRET_ACCESS_KEY``, the region or
    endpoint in ``AWS_REGION``, ``AWS_DEFAULT_REGION`` or ``AWS_ENDPOINT_URL``.
    ``SLATPREP_OBSTORE=no`` forbids it. The reader raises FileNotFoundError, PermissionError or
    OSError.
    """
    known = os.environ.get("AWS_ACCESS_KEY_ID") and os.environ.get("AWS_SECRET_ACCESS_KEY")
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    allowed = os.environ.get("SLATPREP_OBSTORE") != "no" and "AWS_PROFILE" not in os.environ
    if not (allowed and known and (region or endpoint)) or _forked_from_user or not _available():
        return None
    return _reader(bucket, region or "us-east-1", endpoint or "", os.getpid())


@cache
def _available() -> bool:
    import fsspec.config

    # What a user tells fsspec of S3, s3fs alone understands.
    return find_spec("obstore") is not None and not fsspec.config.conf.get("s3")


@cache
def _reader(bucket: str, region: str, endpoint: str, _process: int) -> ReadRange:
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

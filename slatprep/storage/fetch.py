"""Bringing members of archives into the cache, by as few requests as may be."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed

from slatprep.errors import ConfigError, InputError
from slatprep.storage.archives import Archive, shown
from slatprep.storage.tar import BLOCK, MAX_KEPT, Entry

_GAP, _MOST = 2**18, 2**24
"""Bytes between members that are read with them; bytes of one request with several members."""

_AT_ONCE = 8

Members = list[Entry]


def fetch(wanted: Iterable[tuple[Archive, Entry]], progress: Callable[[int, int], None]) -> None:
    """Bring members into the cache that are not there.

    `progress` is called with the bytes that were fetched and those in all. ConfigError if an
    archive cannot be read; one that was replaced is left to whoever reads its members.
    """
    requests = list(_requests(wanted))
    total, done = sum(_span(members)[1] for _, members in requests), 0
    if not requests:
        return
    progress(0, total)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        coming = {pool.submit(_bring, *request): request for request in requests}
        try:
            for future in as_completed(coming):
                archive, members = coming[future]
                try:
                    future.result()
                except InputError:
                    pass
                except OSError as error:
                    raise ConfigError(
                        f"{shown(archive.place)}: cannot be read ({error.strerror or error}); run "
                        "again: what was fetched is kept"
                    ) from None
                done += _span(members)[1]
                progress(done, total)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def _requests(wanted: Iterable[tuple[Archive, Entry]]) -> Iterator[tuple[Archive, Members]]:
    """Yield members that one request brings: of one archive, and near each other."""
    missing: dict[Archive, Members] = {}
    for archive, entry in wanted:
        unusable = archive.packed or entry.problem or entry.size > MAX_KEPT
        if not (unusable or archive.holds(entry)):
            missing.setdefault(archive, []).append(entry)
    for archive, entries in missing.items():
        near: Members = []
        for entry in sorted(set(entries), key=lambda one: one.offset):
            _, length = _span([*near, entry])
            last = near[-1].offset + near[-1].size if near else 0
            if near and (entry.offset - last > _GAP or length > _MOST):
                yield archive, near
                near = []
            near.append(entry)
        if near:
            yield archive, near


def _span(members: Members) -> tuple[int, int]:
    """Return where the header of the first member begins, and the bytes to the last one's end."""
    begin = members[0].offset - BLOCK
    return begin, members[-1].offset + members[-1].size - begin


def _bring(archive: Archive, members: Members) -> None:
    begin, length = _span(members)
    data = archive.range(length, begin)
    for entry in members:
        at = entry.offset - BLOCK - begin
        archive.keep(entry, archive.checked(entry, data[at : at + BLOCK + entry.size]))

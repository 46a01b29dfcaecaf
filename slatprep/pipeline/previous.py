"""The store that a build brings up to date."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache

from slatprep.errors import StoreError
from slatprep.provenance.record import AssetRecord
from slatprep.provenance.stored import StoredRecords
from slatprep.records import Place
from slatprep.store.layout import FORMAT_VERSION
from slatprep.store.reader import Store, open_store


class PreviousBuild:
    """A store that was built before; each process that gets one opens it once.

    Parameters
    ----------
    path : Place
        The store.
    build_id : str
        Id of its build: a process that lives on must not answer with what it
        read of an older store at the same path.
    """

    def __init__(self, path: Place, build_id: str) -> None:
        self.path = path
        self.build_id = build_id

    def __reduce__(self) -> tuple[Callable[[Place, str], PreviousBuild], tuple[Place, str]]:
        return _in_this_process, (self.path, self.build_id)

    @cached_property
    def store(self) -> Store:
        """The store, open."""
        return open_store(self.path)

    @property
    def older_format(self) -> str:
        """Why nothing of it can be reused, in words: its format; empty where that is today's."""
        found = self.store.format_version
        if found == FORMAT_VERSION:
            return ""
        return f"the store has format {found}, and {FORMAT_VERSION} is written"

    @cached_property
    def records(self) -> StoredRecords:
        """Its records."""
        return StoredRecords(self.store)

    @cached_property
    def ids(self) -> frozenset[str]:
        """Ids of its assets."""
        return frozenset(self.store.ids)

    def record(self, asset_id: str) -> AssetRecord | None:
        """Return the record of an asset as its first pass left it, None where it is not there.

        Raises
        ------
        RecordError
            If another version of slatprep wrote it.
        """
        return self.records.of(asset_id).of_first_pass() if asset_id in self.ids else None


@lru_cache(maxsize=1)
def _in_this_process(path: Place, build_id: str) -> PreviousBuild:
    return PreviousBuild(path, build_id)


def previous_build(target: Place) -> PreviousBuild | None:
    """Return the store at a path, None where there is none that a build can go on from."""
    try:
        store = open_store(target)
        return PreviousBuild(store.path, store.attributes["manifest"])
    except (StoreError, KeyError):
        return None  # Of a newer format, or damaged: made anew.

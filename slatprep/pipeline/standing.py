"""Whether the lines of the records beside a store stand, so that an update adds its own behind.

A record takes some 10 kB as a line, a tenth of what a small asset takes in the store: to
write all of them anew for a few would be most of what an update writes.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from slatprep.errors import StoreError
from slatprep.pipeline.carry import KeptAsset
from slatprep.pipeline.rows import Rows
from slatprep.pipeline.update import Update
from slatprep.provenance.files import build_in, lines_in
from slatprep.provenance.record_json import digest_of, read_record
from slatprep.storage.files import is_only_ours
from slatprep.storage.place import storage_of


@dataclass(frozen=True)
class Standing:
    """The lines that stay where they are: all of a file, or none.

    Attributes
    ----------
    digests : mapping of str to bytes
        Of their records, by asset id.
    size : int
        Bytes of the file; 0 where it is written anew.
    """

    digests: Mapping[str, bytes] = field(default_factory=dict)
    size: int = 0


def standing_lines(update: Update, rows: Rows) -> Standing:
    """Return the lines of the existing store's records, if each of them stays as it is.

    Parameters
    ----------
    update : Update
        The build.
    rows : Rows
        What goes into its store, and what does not.
    """
    records = storage_of(update.place.records()).local
    if rows.carried is None or records is None or not update.as_left():
        return Standing()
    before = rows.carried.previous.store.ids
    kept = (asset for asset in rows.usable[: len(before)] if isinstance(asset, KeptAsset))
    digests = {asset.asset_id: asset.record for asset in kept if asset.names is None}
    if list(digests) != list(before):
        return Standing()
    spool = update.context.spool
    failed = {asset.asset_id: digest_of(spool.record(asset.key)) for asset in rows.failed}
    try:
        state, failed_before = records.lstat(), _failed_in(records.parent, len(before))
    except (OSError, StoreError):
        return Standing()
    if not (failed_before.items() <= failed.items() and is_only_ours(state)):
        return Standing()
    return Standing(digests | failed_before, state.st_size)


def _failed_in(folder: Path, usable: int) -> dict[str, bytes]:
    """Return the digests of the assets that the last build could not use, by id."""
    if sum(build_in(folder).statuses.values()) == usable:
        return {}
    lines = (one for one in lines_in(folder) if b'"status":"ok"' not in one[1])
    records = (read_record(line, where) for where, line in lines)
    return {record.asset_id: digest_of(record) for record in records}

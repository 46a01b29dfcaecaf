"""The arrays of a store by name: what their metadata claim is checked before anything is read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import nullcontext
from functools import cached_property
from typing import TYPE_CHECKING, Any

from slatprep.errors import StoreError
from slatprep.records import Place
from slatprep.storage.place import storage_of
from slatprep.storage.remote import connected
from slatprep.store import contract
from slatprep.store.gate import NAMES, gate_findings
from slatprep.store.layout import ASSET_CHUNK, FILE
from slatprep.store.shard_reader import BAD_METADATA, RowReader

if TYPE_CHECKING:
    import zarr


class Arrays:
    """What is below the root of a store, by the root's ``zarr.json``.

    `metadata` are those of its arrays that the root repeats, or that have been read.
    """

    def __init__(self, path: Place, document: Mapping[str, Any]) -> None:
        self.path = path
        self._folder = storage_of(path).folder()
        gathered = document.get("consolidated_metadata")
        metadata = gathered.get("metadata") if isinstance(gathered, dict) else None
        self.metadata: dict[str, Any] = dict(metadata) if isinstance(metadata, dict) else {}
        self._readers: dict[str, RowReader] = {}

    @cached_property
    def group(self) -> zarr.Group:
        """The root as zarr-python has it, for everything this class does not offer.

        Raises
        ------
        StoreError
            If its metadata name anything that `slatprep.store.gate` does not allow.
        """
        import zarr

        self._refuse(f for entry in self.metadata.items() for f in gate_findings(*entry))
        remote = storage_of(self.path).remote
        try:
            # Consolidated, so that zarr-python reads no metadata but those just looked at.
            with connected(remote) if remote else nullcontext():
                return zarr.open_group(
                    str(self.path), mode="r", zarr_format=3, use_consolidated=True
                )
        except (*BAD_METADATA, OSError) as error:
            raise StoreError(f"{self.path}: bad metadata ({error!r})") from None

    def holds(self, name: str) -> bool:
        """Whether the store has an array, by its full name."""
        return name in self.metadata

    def reader(self, name: str) -> RowReader:
        """Return what reads the rows of an array, by its full name.

        StoreError if there is no such array, or its metadata claim another size than the contract
        has, unreasonably large chunks, or codecs that slatprep does not use.
        """
        if name not in self._readers:
            self._readers[name] = self._checked(name)
        return self._readers[name]

    def _checked(self, name: str) -> RowReader:
        of_files = (f"{FILE}/name",) if name.startswith(f"{FILE}/") else ()
        for needed in (*contract.DEFINING, *of_files, name):
            if needed not in self.metadata:
                self.metadata[needed] = self._read(needed)
        try:
            sizes = contract.dimension_sizes(self.metadata)
        except StoreError as error:
            raise StoreError(f"{self.path}/{error}") from None
        own = self.metadata[name]
        self._refuse(contract.size_findings(name, own, sizes))
        self._refuse(gate_findings(name, own))
        # So many assets cost memory by themselves.
        if sizes["asset"] > ASSET_CHUNK and sizes["asset"] * contract.MIN_ASSET_BYTES > self._bytes:
            raise StoreError(
                f"{self.path} has {sizes['asset']} assets in {self._bytes} bytes; expected at "
                f"least {contract.MIN_ASSET_BYTES} bytes an asset; run `slatprep verify`"
            )
        return RowReader.of(self._folder, name, own)

    def _read(self, name: str) -> dict[str, Any]:
        file = self.path / name / "zarr.json"
        if name not in NAMES or not file.exists():
            raise StoreError(f"{self.path} lacks the array {name}; build it again")
        return contract.read_metadata(file)

    def _refuse(self, findings: Iterable[contract.Finding]) -> None:
        for finding in findings:
            raise StoreError(f"{self.path}/{finding}; run `slatprep verify`")

    @cached_property
    def _bytes(self) -> int:
        return sum(max(size, 0) for size in storage_of(self.path).files().values())

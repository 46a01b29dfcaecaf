"""Read what a store says of itself and of each asset: ids, rows and ``asset/*`` columns.

The metadata of an array are checked before the array is read.
"""

from __future__ import annotations

import difflib
import hashlib
import operator
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property
from html import escape
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from slatprep.errors import (
    UNKNOWN,
    ConfigError,
    StoreError,
    UnknownAssetError,
    amount,
    require_one_of,
)
from slatprep.records import Contents, Normalization, Place, Verdict, words_of
from slatprep.storage.place import Folder, storage_of
from slatprep.storage.remote import connected
from slatprep.storage.versions import store_name
from slatprep.store import contract
from slatprep.store.attributes import RootAttributes, read_attributes
from slatprep.store.contract import NAMES, gate_findings
from slatprep.store.layout import ARRAYS, ASSET_CHUNK, FILE, MERGED, last_names
from slatprep.store.shard_reader import BAD_METADATA, DamagedFileError, RowReader, UnreachableError

if TYPE_CHECKING:
    import pandas
    import zarr

ASSET_COLUMNS = [
    name
    for name in last_names("asset", (one for one in ARRAYS if not one.internal))
    if name not in ("id", "offset", "transform")
]
"""Last names of the ``asset/*`` arrays that describe an asset."""


class AttributesError(StoreError):
    """A store whose attributes lack what readers rely on."""


class _Ids(list[str]):
    """The ids of a store's rows; changed ids would name other rows."""

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        raise TypeError("the ids of a store cannot be changed; change a copy, [*store.ids]")

    __setitem__ = __delitem__ = __iadd__ = __imul__ = _refuse
    append = clear = extend = insert = pop = remove = reverse = sort = _refuse

    def __reduce__(self) -> tuple[type, tuple[list[str]]]:
        return list, ([*self],)


class AssetTable:
    """The assets of a store as a table; `slatprep.store.Store` adds their voxels.

    `path` is the store's place, and `document` the root's ``zarr.json``. `metadata` holds the
    arrays' metadata that the root repeats, or that have been read since.
    """

    def __init__(self, path: Place, document: dict[str, Any], folder: Folder | None = None) -> None:
        self.path, self.document = path, document
        self._folder = folder or storage_of(path).folder()
        gathered = document.get("consolidated_metadata")
        metadata = gathered.get("metadata") if isinstance(gathered, dict) else None
        self.metadata: dict[str, Any] = dict(metadata) if isinstance(metadata, dict) else {}
        self._readers: dict[str, RowReader] = {}
        self.attributes: dict[str, Any] = document["attributes"]
        self._columns: dict[str, NDArray[Any]] = {}

    def __len__(self) -> int:
        return len(self.offsets) - 1

    def __contains__(self, asset_id: object) -> bool:
        return asset_id in self._index

    def __repr__(self) -> str:
        try:
            verdicts = Counter(str(verdict) for verdict in self.cached_column("verdict"))
            counts = ", ".join(f"{count:,} {verdict}" for verdict, count in verdicts.most_common())
            total = f"{amount(len(self), 'asset')} ({counts})"
            what = f"{total}, {amount(int(self.offsets[-1]), 'voxel')}"
        except StoreError as error:
            what = f"cannot be read ({error})"
        return f"<Store {self.path}: {what}>"

    def _repr_html_(self) -> str:
        """Return an HTML table of what the store holds, for a notebook."""
        try:
            verdicts = Counter(str(verdict) for verdict in self.cached_column("verdict"))
            rows = {
                "path": self.path,
                "assets": f"{len(self):,}",
                **{f"assets {verdict}": f"{n:,}" for verdict, n in verdicts.most_common()},
                "categories": f"{len(set(map(str, self.cached_column('category'))) - {''}):,}",
                "voxels": f"{self.offsets[-1]:,}",
                "ranges": self.normalization.source,
                "build": self.about.manifest[:12],
            }
        except StoreError as error:
            rows = {"path": self.path, "cannot be read": error}
        cells = "".join(
            f"<tr><th>{escape(name)}</th><td>{escape(str(value))}</td></tr>"
            for name, value in rows.items()
        )
        return f"<table><caption>slatprep store</caption>{cells}</table>"

    @property
    def format_version(self) -> int:
        """Version of the format that it was written in."""
        return int(self.attributes["format_version"])

    @property
    def name(self) -> str:
        """The last part of its path, or of its URL without the version."""
        return store_name(self.path)

    @cached_property
    def about(self) -> RootAttributes:
        """The store's attributes as typed values.

        Raises
        ------
        AttributesError
            If they lack what readers rely on; `open_store` has checked this already.
        """
        found = read_attributes(self.attributes)
        if isinstance(found, tuple):
            raise AttributesError(f"{self.path}/{found[0]}; run `slatprep verify`")
        return found

    @property
    def contents(self) -> Contents:
        """The tables of the store's properties and classes, and its latent space."""
        return self.about.contents

    def columns_of(self, names: Iterable[str]) -> list[int]:
        """Return the indices of properties among the store's property columns.

        Raises
        ------
        StoreError
            If the store lacks one of them.
        """
        held, names = list(self.about.property_columns), words_of(names)
        if missing := [name for name in names if name not in held]:
            lacking, there = " and no ".join(missing), ", ".join(held)
            raise StoreError(
                f"{self.path} has no {lacking}, only {there}; expected a store with "
                f"{', '.join(names)}"
            )
        return [held.index(name) for name in names]

    @property
    def normalization(self) -> Normalization:
        """The ranges that properties were normalised with."""
        return self.about.ranges

    @property
    def merges(self) -> bool:
        """Whether labels of any asset are merged from several annotations."""
        return all(self.holds(layout.name) for layout in MERGED)

    @cached_property
    def ids(self) -> list[str]:
        """Asset ids; they ascend, except where an update added rows at the end.

        The list cannot be changed.
        """
        return _Ids(map(str, self.column("id")))

    @cached_property
    def offsets(self) -> NDArray[np.int64]:
        """Asset a owns rows ``offsets[a]:offsets[a+1]`` of ``voxel/*``, int64 (A+1,)."""
        return self.cached_column("offset")

    def column(self, name: str) -> NDArray[Any]:
        """Read one ``asset/*`` array whole, (A, ...), by its last name.

        Raises
        ------
        StoreError
            If there is no such array, or it cannot be read.
        """
        if f"asset/{name}" not in NAMES:
            raise self.no_column(name, ("id", "offset", "transform", *ASSET_COLUMNS))
        # Offsets are always written, so their file limits the rows that other arrays may claim.
        rows = self.shape("asset/offset")[0] if name == "offset" else len(self)
        return self.read_rows(f"asset/{name}", 0, rows)

    def no_column(self, name: str, columns: Sequence[str]) -> StoreError:
        """Return the error for a name that is not one of the columns."""
        close = difflib.get_close_matches(name, columns, n=1)
        hint = f"did you mean {close[0]}?" if close else f"expected one of {', '.join(columns)}"
        return StoreError(f"{self.path} has no column {name!r}; {hint}")

    def find(self, asset_id: str) -> int:
        """Return the index of the asset with exactly this id.

        Raises
        ------
        UnknownAssetError
            If the store has no such asset; the message suggests similar ids.
        """
        if not isinstance(asset_id, str):
            raise UnknownAssetError(
                f"{asset_id!r} is no id; expected a text, or `match` where numbers are meant"
            )
        if asset_id not in self._index:
            raise _unknown(asset_id, self._index, self.path, self._listing)
        return self._index[asset_id]

    def match(self, name: str | int) -> int:
        """Return the index of an asset, named by its id, by a beginning of it, or by a number.

        Numbers count from 0, negative numbers from the end. A text of digits is a number if no
        id begins with it.

        Raises
        ------
        UnknownAssetError
            If no id, or several ids, begin with the name; the message names some.
        """
        return match_id(name, self._index, self.path, self._listing)

    def having(
        self, verdicts: Collection[str] = (), categories: Collection[str] = ()
    ) -> NDArray[np.bool_]:
        """Return which assets (A,) have one of the verdicts, and one of the categories.

        None takes all, and so does the verdict ``all``. Raises ConfigError if a verdict does not
        exist, or no asset has one of the categories.
        """
        verdicts, categories = words_of(verdicts), words_of(categories)
        for one in verdicts:
            require_one_of("verdict", one, (*Verdict, "all"))
        chosen = np.ones(len(self), bool)
        if verdicts and "all" not in verdicts:
            chosen &= np.isin(self.column("verdict").astype(str), list(verdicts))
        if categories:
            own = self.column("category").astype(str)
            known = sorted(set(own.tolist()))
            if UNKNOWN not in known:  # Tables call the assets without one so.
                categories = ["" if one == UNKNOWN else one for one in categories]
            for one in sorted(set(categories).difference(known)):
                close = difflib.get_close_matches(one, known, n=1) or list(filter(None, known))
                expected = f"expected {', '.join(close)}" if close else "no category is known"
                raise ConfigError(f"{self.path}: no asset has the category {one!r}; {expected}")
            chosen &= np.isin(own, list(categories))
        return chosen

    @property
    def _listing(self) -> str:
        return f"; `slatprep list {self.path}` shows their ids"

    def table(self) -> dict[str, NDArray[Any]]:
        """Return a table of all assets, as columns of A values.

        Returns
        -------
        dict of str to ndarray
            ``id``, ``voxels``, and the arrays of `ASSET_COLUMNS` by their names;
            ``property_ambiguity`` has one column per property. Columns from ``asset/*`` are
            read-only; copy a column to change it.
        """
        columns = {"id": np.array(self.ids, dtype=object), "voxels": np.diff(self.offsets)}
        for name in ASSET_COLUMNS:
            values = self.cached_column(name)
            if values.ndim == 1:
                columns[name] = values
            else:
                names = (f"{name}_{of}" for of in self.attributes["property_columns"])
                columns |= dict(zip(names, values.T, strict=True))
        return columns

    def to_pandas(self) -> pandas.DataFrame:
        """Return `table` as a DataFrame, indexed by id.

        Raises
        ------
        StoreError
            If pandas is not installed, or the store cannot be read.
        """
        try:
            import pandas
        except ImportError:
            raise StoreError(
                "pandas is not installed: pip install pandas, or take `Store.table()`"
            ) from None
        return pandas.DataFrame(self.table()).set_index("id")

    @cached_property
    def _index(self) -> dict[str, int]:
        return {asset_id: index for index, asset_id in enumerate(self.ids)}

    def cached_column(self, name: str) -> NDArray[Any]:
        """Return an ``asset/*`` array as `column` does, but read it once; it is read-only."""
        if name not in self._columns:
            self._columns[name] = self.column(name)
            self._columns[name].flags.writeable = False
        return self._columns[name]

    def read_rows(self, name: str, start: int, stop: int) -> NDArray[Any]:
        """Read rows (stop - start, ...) of any array by its full name, such as ``voxel/coords``.

        Raises
        ------
        StoreError
            If there is no such array or row, or a file is missing or damaged.
        """
        reader = self.reader(name)
        try:
            return reader.read(start, stop)
        except (DamagedFileError, UnreachableError) as error:
            # Zarr writes no file for fill values alone, such as a column of empty strings.
            may_lack = name.startswith("asset/") and name != "asset/offset"
            if not may_lack or error.file in self._written:
                raise
        reader.listed = self._written
        return reader.read(start, stop)

    def shape(self, name: str) -> tuple[int, ...]:
        """Return the shape of an array, from its metadata alone."""
        return self.reader(name).shape

    @cached_property
    def group(self) -> zarr.Group:
        """The root as a group of zarr-python, for everything that this class does not offer.

        It opens each file by its path, so it must not be used once the store is replaced.

        Raises
        ------
        StoreError
            If the metadata name anything that `slatprep.store.contract` does not allow, or another
            store is there now.
        """
        import zarr

        self._refuse(f for entry in self.metadata.items() for f in gate_findings(*entry))
        remote = storage_of(self.path).remote
        try:
            # Consolidated, so that zarr-python reads only the metadata that were just checked.
            with connected(remote) if remote else nullcontext():
                group = zarr.open_group(
                    str(self.path), mode="r", zarr_format=3, use_consolidated=True
                )
        except (*BAD_METADATA, OSError) as error:
            raise StoreError(f"{self.path}: bad metadata ({error!r})") from None
        if dict(group.attrs) != self.attributes:
            raise other_store(self.path)
        return group

    def holds(self, name: str) -> bool:
        """Return whether the store has an array, by its full name."""
        return name in self.metadata

    def reader(self, name: str) -> RowReader:
        """Return the reader of the rows of an array, by the array's full name.

        StoreError if there is no such array, or its metadata claim a size that the contract does
        not allow, unreasonably large chunks, or codecs that slatprep does not use.
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
        # A large number of assets costs memory by itself, so the files must account for it.
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
    def _written(self) -> frozenset[str]:
        """Names of the files that were written, as the store lists them."""
        name = f"{FILE}/name"
        return frozenset(map(str, self.read_rows(name, 0, self.shape(name)[0])))

    @cached_property
    def identity(self) -> str:
        """A digest of the build's id and the order of the rows, which another store lacks.

        StoreError if the ids cannot be read.
        """
        words = "\n".join([str(self.attributes.get("manifest")), *self.ids])
        return hashlib.sha256(words.encode("utf-8", "surrogatepass")).hexdigest()

    @cached_property
    def _bytes(self) -> int:
        return sum(max(size, 0) for size in storage_of(self.path).files().values())


def match_id(name: str | int, rows: Mapping[str, int], where: object, listing: str = "") -> int:
    """Return the row that a name means, as `AssetTable.match` does; `rows` are by id.

    UnknownAssetError names `where` the ids are, and has `listing`, a hint at how to list them.
    """
    if not isinstance(name, str):
        return number_of(name, len(rows), where)
    if name in rows:
        return rows[name]  # A loop over all assets must not search all ids each time.
    alike = [known for known in rows if known.startswith(name)] if name else []
    if len(alike) == 1:
        return rows[alike[0]]
    views = all(known.startswith(f"{name}.") for known in alike)
    if alike and not views:
        raise UnknownAssetError(
            f"{where}: {len(alike)} ids begin with {name!r}, such as "
            f"{', '.join(alike[:3])}; give more of it"
        )
    if not alike and name.isascii() and name.isdigit():
        return number_of(int(name), len(rows), where)
    raise _unknown(name, rows, where, listing)


def number_of(row: int, count: int, where: object) -> int:
    """Return the number of one of `count` rows, counted from 0; negative ones count from the end.

    UnknownAssetError, naming `where`, if there is no such row, or for an entry of a mask.
    """
    if isinstance(row, bool | np.bool_):
        raise UnknownAssetError(
            f"{row} is an entry of a mask, not an asset; expected the rows that the mask chooses: "
            "numpy.flatnonzero(mask)"
        )
    try:
        number = operator.index(row)
    except TypeError:
        raise UnknownAssetError(
            f"{row!r:.80} names no asset; expected one id or one number"
        ) from None
    if not -count <= number < count:
        raise UnknownAssetError(
            f"{where} has no asset {number}; it has {amount(count, 'asset')}, numbered from 0"
        )
    return number % count


def other_store(path: Place) -> StoreError:
    """Return the error that a store was replaced since it was opened."""
    return StoreError(
        f"{path}: is another store than the one that was opened (was the store replaced?); "
        "open it again"
    )


def _unknown(name: str, rows: Mapping[str, int], where: object, listing: str) -> UnknownAssetError:
    """Return the error for an unknown name; it suggests similar ids."""
    alike = name.casefold()
    begun = [known for known in rows if alike and known.casefold().startswith(alike)]
    close = begun or difflib.get_close_matches(name, rows)
    hint = f"it has {amount(len(rows), 'asset')}{listing}"
    if close:
        hint = f"did you mean {' or '.join(close[:5])}?"
    return UnknownAssetError(f"{where} has no asset {name!r}; {hint}")

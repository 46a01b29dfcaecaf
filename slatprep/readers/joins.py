"""Maps of ids, categories, and explanations why the names of the two sides do not match."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Collection, Iterable
from functools import partial
from itertools import chain
from typing import TextIO

from slatprep.errors import ConfigError, in_unicode
from slatprep.parameters import BuildParameters
from slatprep.readers.files import NO_SLAT
from slatprep.records import MAX_NAME_BYTES, AssetPair, Place
from slatprep.storage.documents import read_bounded, unique
from slatprep.storage.place import storage_of

MAX_JSON_BYTES = 256 * 2**20
"""Largest file of categories; a file of 500,000 objects takes 50 MB."""

_LONGEST_LINE = 2**24
"""Longest line of a map of ids, in letters; TRELLIS's captions take some thousand."""

_FORMS = (("object_id", "slat_id"), ("file_identifier", "sha256"))
"""Columns that name objects and SLATs, in slatprep's own tables and in TRELLIS's."""

_UID = re.compile(r"([0-9a-f]{32})/?$")


def read_map(
    path: Place, objects: Collection[str], slats: Collection[str]
) -> dict[str, list[tuple[str, str]]]:
    """Return the SLATs of each object as (SLAT id, view or an empty string).

    The file is a CSV with columns ``object_id``, ``slat_id`` and optionally ``view``, or TRELLIS's
    ``metadata.csv``. There, ``sha256`` names the SLAT, and ``file_identifier`` is a URL that ends
    in the object's uid; only rows that name an id of `objects` or `slats` count. ConfigError if
    the file is neither.
    """
    claims: dict[str, dict[tuple[str, str], None]] = {}
    try:
        with io.TextIOWrapper(storage_of(path).open(), "utf-8-sig", newline="") as file:
            reader = csv.DictReader(iter(partial(_line_of, file), ""))
            columns = set(reader.fieldnames or ())
            for name in ("view", *chain.from_iterable(_FORMS)):
                if (reader.fieldnames or ()).count(name) > 1:
                    raise ConfigError(f"{path}: has two columns {name}; expected one")
            form = next((one for one in _FORMS if columns.issuperset(one)), None)
            if form is None:
                parted = len(columns) == 1 and any(sign in min(columns) for sign in ";\t")
                hint = "; save it with commas between the columns" if parted else ""
                raise ConfigError(
                    f"{path}: columns {', '.join(sorted(columns)) or 'none'}; expected object_id "
                    f"and slat_id, or TRELLIS's sha256 and file_identifier{hint}"
                )
            own = form[0] == "object_id"
            for row in reader:
                object_id, slat_id = row[form[0]] or "", row[form[1]] or ""
                if own and not (object_id and slat_id):
                    raise ConfigError(f"{path}, line {reader.line_num}: empty object_id or slat_id")
                if not own:
                    object_id = _object_of(object_id)
                if own or (object_id and (object_id in objects or slat_id in slats)):
                    view = (row.get("view") or "") if own else ""
                    claims.setdefault(object_id, {})[slat_id, view] = None
    except (OSError, csv.Error, UnicodeDecodeError) as error:
        reason = "save it as CSV in UTF-8" if isinstance(error, UnicodeDecodeError) else error
        raise ConfigError(f"{path}: cannot be read as a map of ids ({reason})") from None
    return {object_id: list(named) for object_id, named in claims.items()}


def _line_of(file: TextIO) -> str:
    """Return the next line; csv.Error if it is too long, as in a file without line breaks."""
    line = file.readline(_LONGEST_LINE)
    if len(line) == _LONGEST_LINE:
        raise csv.Error(f"a line has more than {_LONGEST_LINE:,} letters")
    return line


def read_categories(path: Place) -> dict[str, str]:
    """Read the category of each object from Pixie's ``obj_ids_metadata.json``.

    Raises ConfigError if the file cannot be read or an entry has no ``obj_class``.
    """
    try:
        entries = json.loads(read_bounded(path, MAX_JSON_BYTES), object_pairs_hook=unique)
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read as JSON ({error})") from None
    if not isinstance(entries, dict):
        raise ConfigError(f'{path}: expected an object {{uid: {{"obj_class": category}}}}')
    categories = {}
    for object_id, entry in entries.items():
        category = entry.get("obj_class") if isinstance(entry, dict) else None
        if not isinstance(category, str):
            raise ConfigError(f"{path}: {object_id!r} has no obj_class; expected a category")
        if len(category) > MAX_NAME_BYTES // 4:
            raise ConfigError(
                f"{path}: the obj_class of {object_id[:80]!r} has {len(category)} letters; "
                f"expected at most {MAX_NAME_BYTES // 4}"
            )
        categories[object_id] = in_unicode(category.strip())
    return categories


def _object_of(file_identifier: str) -> str:
    """Return the object's uid from TRELLIS's file identifier, or its last path component."""
    uid = _UID.search(file_identifier)
    return uid.group(1) if uid else file_identifier.rstrip("/").rpartition("/")[2]


def explain_unmatched(pairs: Collection[AssetPair], parameters: BuildParameters) -> str:
    """Say in a line that the names of the two sides have nothing in common, or return "".

    `pairs` is what `discover` returned for `parameters`.
    """
    alone = [pair for pair in pairs if pair.slat is None and pair.grid is not None]
    grids = [pair.object_id for pair in alone if NO_SLAT in pair.problem]
    slats = [pair.object_id for pair in pairs if pair.grid is None and pair.slat is not None]
    if not grids or not slats or any(pair.grid and pair.slat for pair in pairs):
        return ""
    table, root = parameters.pairing.map, parameters.slat.root
    folders = {pair.object_id for pair in pairs if pair.view and pair.slat is not None}
    if table is None and len(folders) == 1 and {*slats} == folders and len(slats) > 1:
        return (
            f"no id occurs on both sides: the SLATs lie one folder deeper; point at "
            f"{root / slats[0]}"
        )
    if table is not None:
        hint = f"the table {table} joins none of them"
    else:
        own = root / "metadata.csv"
        example = own if own.is_file() and _joins(own, grids, slats) else "FILE.csv"
        hint = f"name a table that joins them: --map {example} (docs/configuration.md, [pairing])"
    return (
        f"no id occurs on both sides: {len(grids):,} grids such as {grids[0][:40]!r}, "
        f"{len(slats):,} SLATs such as {slats[0][:40]!r}; {hint}"
    )


def _joins(table: Place, grids: Collection[str], slats: Collection[str]) -> bool:
    """Return whether a table is a map of ids that names one of these."""
    try:
        return bool(read_map(table, grids, slats))
    except ConfigError:
        return False


def by_case(grids: Iterable[str], slats: Iterable[str]) -> dict[str, str]:
    """Return the other side's id for each id that occurs there only in another letter case."""
    ours, theirs = set(grids), set(slats)
    found = dict[str, str]()
    for names, others in (ours - theirs, theirs - ours), (theirs - ours, ours - theirs):
        folded = {other.casefold(): other for other in sorted(others, reverse=True)}
        found |= {name: folded[name.casefold()] for name in names if name.casefold() in folded}
    return found

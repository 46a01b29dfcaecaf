"""Finding SLATs by name: files of a folder, groups of HDF5 files, or both."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from urllib.parse import quote

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import SlatSource
from slatprep.readers.adapters import latent_adapter
from slatprep.readers.hdf5 import SUFFIXES, find_groups
from slatprep.readers.patterns import LOOKED_AT, find_files, held_names, list_below, tried_names
from slatprep.records import Place
from slatprep.records.encoders import LATENTS
from slatprep.storage.archives import is_archive
from slatprep.storage.place import storage_of

_UNPACKED = "and SLATs are read unpacked: `tar -xf ARCHIVE -C FOLDER`, then point at FOLDER"


@dataclass(frozen=True, slots=True)
class NamedSlat:
    """A SLAT and the names it was found by; `path` is relative to the folder of all SLATs.

    It is empty if only a map of ids names the SLAT. `problem` says why it cannot be used.
    """

    slat_id: str
    view: str
    path: str
    group: str = ""
    problem: str = ""


def discover_slats(source: SlatSource) -> tuple[Place, dict[str, NamedSlat]]:
    """Find SLATs that need no partner.

    Parameters
    ----------
    source : SlatSource
        A folder of SLATs, an npz, or an HDF5 file with one SLAT or a group for each.

    Returns
    -------
    Place
        The folder that their paths begin at.
    dict of str to NamedSlat
        Sorted by id, ``<id>`` or ``<id>.<view>``, each once. The name of a single file
        is its id.

    Raises
    ------
    ConfigError
        If there are no SLATs.
    """
    root, one_file = source.root, source.root.is_file()
    if not one_file and not root.exists():
        raise ConfigError(f"{root}: does not exist; expected a SLAT, or a folder of them")
    if one_file and root.suffix not in (".npz", *SUFFIXES):
        raise ConfigError(
            f"{root}: expected a SLAT as .npz, {' or '.join(SUFFIXES)}, or a folder of them"
        )
    if one_file:
        slats = list(_each_slat(source, True)) if root.suffix != ".npz" else []
        slats = slats or [NamedSlat(root.name.rpartition(".")[0], "", root.name)]
    else:
        slats = [slat for found in find_slats(source, False).values() for slat in found]
    named: dict[str, NamedSlat] = {}
    for slat in ordered(slats):
        asset_id = encoded(f"{slat.slat_id}.{slat.view}" if slat.view else slat.slat_id)
        twice = f"two SLATs have the id {asset_id!r}" if asset_id in named else ""
        named[asset_id] = replace(slat, problem=slat.problem or twice)
    return root.parent if one_file else root, dict(sorted(named.items()))


def find_slats(source: SlatSource, one_file: bool) -> dict[str, list[NamedSlat]]:
    """Return the SLATs of a folder or an HDF5 file by their ids.

    Raises ConfigError if there are none or the file cannot be read.
    """
    root, slats = source.root, dict[str, list[NamedSlat]]()
    if one_file and is_archive(root.name):
        raise ConfigError(f"{root}: is an archive, {_UNPACKED}")
    if one_file and root.suffix == ".npz":
        raise ConfigError(f"{root}: is one SLAT; point at its folder, {root.parent}")
    for slat in _each_slat(source, one_file):
        slats.setdefault(slat.slat_id, []).append(slat)
    if not slats:
        tried = f"groups {source.group}" if one_file else tried_names(slat_patterns(source), {})
        hint = "" if one_file else _hint(source)
        raise ConfigError(f"{source.root}: no SLAT found; looked for {tried}{hint}")
    problems = [slat.problem for found in slats.values() for slat in found if slat.problem]
    if one_file and problems:
        raise ConfigError(problems[0])
    return slats


def _hint(source: SlatSource) -> str:
    """Say which folder below the root has SLATs, or what the root holds; empty if unknown."""
    try:
        files, folders = storage_of(source.root).names()
        for name in sorted(folders)[:LOOKED_AT]:
            below = replace(source, root=source.root / name)
            if any(_each_slat(below, False)):
                return f"; SLATs lie in {below.root}: point at that"
    except (OSError, ConfigError):
        return ""
    if archives := sorted(filter(is_archive, files)):
        return f"; it holds {archives[0]}, {_UNPACKED}"
    return f"; {held_names(files, folders)}"


def slat_patterns(source: SlatSource) -> tuple[str, ...]:
    """Return the dataset definition's patterns of SLATs, or the encoder's if it states none."""
    usual = SlatSource.pattern
    if source.pattern != usual:
        return source.pattern
    if (space := LATENTS.get(source.encoder)) is None:
        own: tuple[str, ...] = getattr(latent_adapter(source.encoder), "patterns", ())
        return own or usual
    if not space.encoder.startswith("trellis2"):
        return usual
    # The folder into which TRELLIS.2's toolkit puts latents of this kind and resolution.
    kind = "pbr" if space.encoder.startswith("trellis2-pbr") else "shape"
    folder = f"{kind}_latents/*_{16 * space.resolution}/"
    return tuple(one.replace("shape_latents/*_1024/", folder) for one in usual)


def _each_slat(source: SlatSource, one_file: bool) -> Iterator[NamedSlat]:
    if one_file:
        yield from _each_group(source, source.root.parent, source.root.name)
        return
    listing = list_below(source.root)
    unlisted: set[str] = set()
    for pattern in slat_patterns(source):
        for fields, path, problem in find_files(listing, pattern, {}):
            if path in unlisted:
                continue
            if problem:
                unlisted.add(path)
            if problem or "id" in fields:
                slat_id, view = fields.get("id", path), fields.get("view", "")
                yield NamedSlat(slat_id, view, path, problem=problem)
            else:
                yield from _each_group(source, source.root, path, fields)


def _each_group(
    source: SlatSource, root: Place, path: str, known: Mapping[str, str] | None = None
) -> Iterator[NamedSlat]:
    """Yield the SLATs that are groups of one HDF5 file."""
    if "{id}" not in source.group:
        raise ConfigError(f"group pattern {source.group!r} names no {{id}}")
    try:
        for fields, group in find_groups(root / path, root, source.group, known or {}):
            yield NamedSlat(fields["id"], fields.get("view", ""), path, group)
    except InputError as error:
        yield NamedSlat(path, "", path, problem=str(error))


def ordered(slats: Iterable[NamedSlat]) -> tuple[NamedSlat, ...]:
    """Return SLATs in an order that does not depend on the file system."""
    return tuple(sorted(slats, key=lambda slat: (slat.path, slat.group, slat.slat_id)))


def encoded(name: str) -> str:
    """Return a valid id unchanged, and any other name percent-encoded."""
    return quote(name.encode(errors="surrogateescape"), safe="").replace("~", "%7E")

"""PixieVerse as it is published: find its grids below the folder or archive that a user names.

The dataset on the hub has ``archives/DIRECTORY/CLASS.tar``, which its own instructions unpack
into ``DIRECTORY/``. Grids are in the directory ``render_outputs``.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import replace

from slatprep.errors import ConfigError, SlatprepError, first_of
from slatprep.parameters import PixieverseSource
from slatprep.readers.adapters import source_adapter
from slatprep.readers.patterns import LOOKED_AT, fill, held_names
from slatprep.readers.voxels import DESCRIPTION
from slatprep.records import AssetPair, Place
from slatprep.storage.archives import is_archive, shown
from slatprep.storage.members import ArchivePlace, ArchiveTree, fetch
from slatprep.storage.place import storage_of

GRIDS, ARCHIVES = "render_outputs", "archives"

_PACKED = (".tar.xz", ".tar.bz2", ".tar.zst", ".txz", ".tbz2", ".zip", ".7z", ".rar")
"""Ends of the names of archives that slatprep does not read."""

_EVERY_S = 10.0
"""Seconds between two lines about progress."""

OTHERS = {
    "data": "rendered views",
    "outputs": "reconstructions",
    "vlm_seg_results": "segmentations",
    "vlm_seg_critic_results": "judgements of segmentations",
    "vlm_seg_mat_sample_results": "sampled materials",
}
"""Content of the dataset's other directories, by name."""


def locate_grids(source: PixieverseSource, note: Callable[[str], None] | None = None) -> Place:
    """Return the folder of the objects below a source's root, which may lie in archives.

    The root is the dataset's, its folder of archives, one archive, or the objects' folder.
    ConfigError if an archive or its folder cannot be read.
    """
    root = source.root
    if source.adapter != PixieverseSource.adapter:
        return root
    wanted = wanted_members(source)
    if any(pattern.startswith((f"{GRIDS}/", f"{ARCHIVES}/")) for pattern in wanted):
        return root  # The user's own patterns begin at the root.
    try:
        if is_archive(root.name) and root.is_file():
            return _tree(root.parent, [root.name], wanted, str(root), note)
        for _ in range(3):
            files, folders = storage_of(root).names()
            if archives := sorted(name for name in files if is_archive(name)):
                packed = (name for name in files if name.lower().endswith(_PACKED))
                beside = sorted(n for n in (*folders, *packed) if not n.startswith("."))
                if note and beside:
                    unread = first_of(beside, 1)
                    note(f"{root}: its archives are read, but not {unread} beside them")
                return _tree(root, archives, wanted, str(root), note)
            inner = next((name for name in (GRIDS, ARCHIVES) if name in folders), "")
            if not inner:
                break
            root = root / inner
    except OSError as error:
        what = error.strerror or error
        raise ConfigError(f"{error.filename or root}: cannot be looked at ({what})") from None
    return root


def fetch_members(pairs: Iterable[AssetPair], note: Callable[[str], None] | None) -> None:
    """Fetch the members of remote archives that pairs need into the cache, and report progress.

    ConfigError if an archive cannot be read.
    """
    wanted = [
        (place.archive, place.entry)
        for pair in pairs
        if not pair.problem
        for one in pair.annotations
        for _, place in one.files
        if isinstance(place, ArchivePlace) and place.archive and place.entry
    ]
    fetch(wanted, _telling("fetched", note))


def _telling(what: str, note: Callable[[str], None] | None) -> Callable[[int, int], None]:
    """Return a function that takes the bytes done and all bytes, and notes them now and then."""
    told, last = time.monotonic(), 0

    def tell(done: int, total: int) -> None:
        nonlocal told, last
        if note and done > last and (time.monotonic() - told > _EVERY_S or done == total):
            told, last = time.monotonic(), done
            note(f"{what} {done / 1e6:,.0f} of {total / 1e6:,.0f} MB")

    return tell


def hint_of(source: PixieverseSource) -> str:
    """Say what a root without grids holds, and what to point at; empty if nothing is known."""
    root, adapter = source.root, source_adapter(source.adapter)
    named = next((place.name for place in (root, root.parent) if place.name in OTHERS), "")
    try:
        place = locate_grids(source)
        if named:
            folder = (root if root.name == named else root.parent).parent
            near = (folder / GRIDS, folder / ARCHIVES / GRIDS)
            beside = next((place for place in near if place.is_dir()), GRIDS)
            return f"it holds Pixie's {OTHERS[named]}; grids are in {beside}"
        if isinstance(place, ArchivePlace):
            return _held_in_archives(place)
        files, folders = storage_of(place).names()
        if any(name == "material_grid.npy" for name in files):
            return f"it is a sample of one object; point at {place.parent.parent}"
        if any(name.startswith("sample_") for name in folders):
            return f"it is the folder of one object; point at {place.parent}"
        if DESCRIPTION in files and source.adapter == PixieverseSource.adapter:
            way = 'say adapter = "voxels" in [pixieverse] of the dataset definition'
            return f"it holds {DESCRIPTION}, which describes plain voxels; {way}"
        if known := sorted(OTHERS.keys() & {*folders}):
            return f"it holds Pixie's {', '.join(known)}, and no {GRIDS}, which has the grids"
        inner = [place / name for name in sorted(folders)]
        for _ in range(LOOKED_AT):
            if not inner:
                break
            below = replace(source, root=inner.pop(0))
            if any(adapter.find(below, storage_of(locate_grids(below)).listing())):
                return f"grids lie in {below.root}; point at that"
            inner += [below.root / name for name in sorted(storage_of(below.root).names()[1])]
    except (OSError, SlatprepError):
        return ""
    return held_names(files, folders)


def _held_in_archives(place: ArchivePlace) -> str:
    indexes = place.tree.indexes
    names = [name for index in indexes.values() for name in list(index.members)[:1]]
    if not names:
        return f"its {len(indexes)} archives hold no file"
    return f"its archives hold files such as {names[0]}; grids are in archives/{GRIDS}"


def category_of(grid: Place | None) -> str:
    """Return the category that a grid's archive is named after; empty if there is none."""
    if not isinstance(grid, ArchivePlace) or grid.archive is None:
        return ""
    name = grid.archive.place.name.partition(".")[0]
    return "" if name in (GRIDS, ARCHIVES, "pixieverse") else name


def _tree(
    folder: Place,
    names: list[str],
    wanted: tuple[str, ...],
    text: str,
    note: Callable[[str], None] | None,
) -> ArchivePlace:
    archives = storage_of(folder).archives(names, wanted)
    tree = ArchiveTree(text, archives, _telling("archives: looked through", note))
    for archive, index in tree.indexes.items() if note else ():
        if note and (told := index.told()):
            note(f"{shown(archive.place)}: {told}")
    return ArchivePlace(tree)


def wanted_members(source: PixieverseSource) -> tuple[str, ...]:
    """Return patterns of all files of a source that a build may read."""
    patterns = (*source.grid, *source.mask, *source.bounds, source.transform)
    return tuple(fill(pattern, {}) for pattern in patterns if pattern)

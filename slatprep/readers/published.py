"""PixieVerse as it is published: where its grids lie below whatever a user points at.

The dataset on the hub has ``archives/DIRECTORY/CLASS.tar``, which its own instructions unpack
into ``DIRECTORY/``. Grids are in the directory ``render_outputs``.
"""

from __future__ import annotations

from slatprep.errors import ConfigError
from slatprep.parameters import PixieverseSource
from slatprep.readers.patterns import fill
from slatprep.records import Place
from slatprep.storage.archives import is_archive
from slatprep.storage.members import ArchivePlace, ArchiveTree
from slatprep.storage.place import storage_of

GRIDS, ARCHIVES = "render_outputs", "archives"

OTHERS = {
    "data": "rendered views",
    "outputs": "reconstructions",
    "vlm_seg_results": "segmentations",
    "vlm_seg_critic_results": "judgements of segmentations",
    "vlm_seg_mat_sample_results": "sampled materials",
}
"""What the other directories hold."""


def locate_grids(source: PixieverseSource) -> Place:
    """Return the folder of the objects below what a source names, which archives may hold.

    Parameters
    ----------
    source : PixieverseSource
        Its root is the dataset's, its folder of archives, one archive, or the objects' folder.

    Returns
    -------
    Place
        The root itself where nothing says otherwise.

    Raises
    ------
    ConfigError
        If an archive or its folder cannot be looked at.
    """
    root = source.root
    if source.adapter != PixieverseSource.adapter:
        return root
    wanted = _wanted(source)
    if any(pattern.startswith((f"{GRIDS}/", f"{ARCHIVES}/")) for pattern in wanted):
        return root  # The user's own patterns begin at the root.
    try:
        if is_archive(root.name) and root.is_file():
            return _tree(root.parent, [root.name], wanted, str(root))
        for _ in range(3):
            files, folders = storage_of(root).names()
            archives = sorted(name for name in files if is_archive(name))
            if archives:
                return _tree(root, archives, wanted, str(root))
            inner = next((name for name in (GRIDS, ARCHIVES) if name in folders), "")
            if not inner:
                break
            root = root / inner
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be looked at ({error.strerror})") from None
    return root


def category_of(grid: Place | None) -> str:
    """Return the class that the name of a grid's archive tells; empty where none does."""
    if not isinstance(grid, ArchivePlace) or grid.archive is None:
        return ""
    name = grid.archive.category
    return "" if name in (GRIDS, ARCHIVES, "pixieverse") else name


def _tree(folder: Place, names: list[str], wanted: tuple[str, ...], text: str) -> ArchivePlace:
    return ArchivePlace(ArchiveTree(text, storage_of(folder).archives(names, wanted)))


def _wanted(source: PixieverseSource) -> tuple[str, ...]:
    """Return patterns of all files of a source that a build may read."""
    patterns = (*source.grid, *source.mask, *source.bounds, source.transform)
    return tuple(fill(pattern, {}) for pattern in patterns if pattern)

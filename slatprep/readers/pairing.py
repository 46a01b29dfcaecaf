"""Finding the two sides of every asset by name alone, without reading content.

Memory holds only names: an entry per object and per SLAT, never an array.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, groupby, product

from slatprep.errors import ConfigError, amount, first_of, in_unicode
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.readers import adapters
from slatprep.readers.contents import contents_of
from slatprep.readers.files import NO_SLAT
from slatprep.readers.joins import by_case, read_categories, read_map
from slatprep.readers.patterns import NAME, fill, find_files, list_below, tried_names
from slatprep.readers.published import category_of, hint_of, locate_grids
from slatprep.readers.slat_files import NamedSlat, encoded, find_slats, ordered, slat_patterns
from slatprep.records import AssetPair, Place, SourceRoots
from slatprep.storage.archives import is_archive
from slatprep.storage.files import Listing
from slatprep.storage.place import storage_of

LOOKED_FOR = "; looked for "
"""Text in the problem of a pair before the names that its files might have had."""


@dataclass(frozen=True, slots=True)
class _Row:
    """A future row of the store: an object and its SLATs with this label, normally just one."""

    asset_id: str
    object_id: str
    view: str
    slats: tuple[NamedSlat, ...]
    sample: str | None = None
    """Sample of the object that the row is made of; None for all samples."""


@dataclass(frozen=True, slots=True)
class _Found:
    """The names of a source's files; `listing` lists its root.

    If all SLATs are in one file, `roots` has its folder.
    """

    source: PixieverseSource
    slat: SlatSource
    roots: SourceRoots
    listing: Listing
    grids: Mapping[str, list[adapters.FoundField]]
    categories: Mapping[str, str]
    cases: Mapping[str, str]
    """The other side's id, for each id that it has only in another letter case."""


def discover(
    parameters: BuildParameters, note: Callable[[str], None] | None = None
) -> list[AssetPair]:
    """Find the pairs of a dataset.

    Parameters
    ----------
    parameters : BuildParameters
        The roots, patterns and maps of the sources.
    note : callable, optional
        Gets lines for the user while archives are searched.

    Returns
    -------
    list of AssetPair
        Sorted by `asset_id`, each id once. An unusable pair says why in `problem`.
        Each takes 1.2 kB of memory.

    Raises
    ------
    ConfigError
        If a root does not exist, a pattern or map makes no sense, or a side has no files.
    """
    pixieverse, slat, pairing = parameters.pixieverse, parameters.slat, parameters.pairing
    sources = (pixieverse, *parameters.also)
    for root in (*(source.root for source in sources), slat.root):
        if fault := _unrecordable(str(root)):
            raise ConfigError(fault)
    try:
        for source in sources:
            if not source.root.is_dir() and not is_archive(source.root.name):
                missing = storage_of(source.root).absent()
                absent = "is another file" if source.root.exists() else missing
                raise ConfigError(
                    f"{source.root}: {absent}; expected PixieVerse's folder or an archive of it"
                )
        if not slat.root.exists():
            raise ConfigError(
                f"{slat.root}: {storage_of(slat.root).absent()}; expected a folder of SLATs or an "
                "HDF5 file"
            )
        folder = slat.root.parent if slat.root.is_file() else slat.root
    except OSError as error:
        raise ConfigError(f"{error.filename}: cannot be looked at ({error.strerror})") from None
    places = [locate_grids(source, note) for source in sources]
    listings = [list_below(place) for place in places]
    each = [_grids_of(*both, slat) for both in zip(sources, listings, strict=True)]
    grids, slats = each[0], find_slats(slat, folder != slat.root)
    claims = {} if pairing.map is None else read_map(pairing.map, grids, slats)
    categories = {} if pairing.categories is None else read_categories(pairing.categories)
    damaged = _damaged_in(parameters.also, each)
    rows = list(_rows(damaged | grids, slats, claims, each_sample=pixieverse.samples == "all"))
    rows.sort(key=lambda row: (row.asset_id, row.object_id))
    contents, cases = contents_of(parameters), by_case(grids, slats)
    found = []
    for k, source in enumerate(sources):
        roots = SourceRoots(
            places[k], folder, contents, source.adapter, k, source.units, source.plausibility
        )
        found.append(_Found(source, slat, roots, listings[k], each[k], categories, cases))
    pairs = list(_pairs(rows, found))
    if note is not None:
        for line in _unused(pairs, sources):
            note(line)
    return pairs


def _damaged_in(
    also: Sequence[PixieverseSource], each: Sequence[Mapping[str, list[adapters.FoundField]]]
) -> dict[str, list[adapters.FoundField]]:
    """Return what cannot be read in further sources, such as damaged archives: no grids by name.

    `each` has the grids of all sources. ConfigError if a further one has no object of the first.
    """
    grids, *others = each
    broken = [{name for name, found in one.items() if found[0].problem} for one in each]
    for source, own, faults in zip(also, others, broken[1:], strict=True):
        if not (broken[0] or faults) and own.keys().isdisjoint(grids):
            raise ConfigError(
                f"{source.root}: has none of the objects that [pixieverse] has; expected ids such "
                f"as {min(grids)!r}, found {min(own)!r}"
            )
    return {name: [] for faults in broken[1:] for name in faults}


def _unused(pairs: Sequence[AssetPair], sources: Sequence[PixieverseSource]) -> Iterator[str]:
    """Yield a line for masks and bounds whose patterns name no file, and for masks of some only."""
    for number, source in enumerate(sources):
        annotations = chain.from_iterable(pair.annotations for pair in pairs)
        own = [one for one in annotations if one.roots.number == number]
        for role in ("mask", "bounds"):
            given, lacking = getattr(source, role), [one for one in own if not getattr(one, role)]
            if len(lacking) == len(own):
                if given and given != getattr(PixieverseSource, role):
                    yield f"{source.root}: no {role} found; looked for {tried_names(given, {})}"
            elif role == "mask" and (
                names := {one.object_id for one in lacking if not one.problem}
            ):
                told = f"{amount(len(names), 'object')} without a mask ({first_of(sorted(names))})"
                yield f"{source.root}: {told}, where background counts as empty; others have one"


def _grids_of(
    source: PixieverseSource, listing: Listing, slat: SlatSource
) -> dict[str, list[adapters.FoundField]]:
    """Return the grids by `find_grids`; ConfigError if there are none."""
    if grids := adapters.find_grids(source, listing):
        return grids
    tried = _tried_grids(source, {})
    # Only for PixieVerse: files of plain voxels have the same names as SLATs.
    ours = source.adapter == PixieverseSource.adapter and slat.root.is_dir()
    other = replace(source, root=slat.root)
    swapped = ours and adapters.find_grids(other, list_below(locate_grids(other)))
    hint = f"the roots are swapped: grids lie below {slat.root}" if swapped else hint_of(source)
    more = f"; {hint}" if hint else ""
    raise ConfigError(f"{source.root}: no grid found; looked for {tried}{more}")


def _rows(
    grids: Mapping[str, list[adapters.FoundField]],
    slats: Mapping[str, list[NamedSlat]],
    claims: Mapping[str, list[tuple[str, str]]],
    *,
    each_sample: bool,
) -> Iterator[_Row]:
    """Join objects and SLATs: by the map if it names them, by equal id otherwise.

    With `each_sample`, an object has a row for each of its samples.
    """
    claimed = {slat_id for named in claims.values() for slat_id, _ in named}
    for object_id in {*grids, *claims, *(slats.keys() - claimed)}:
        labelled: dict[str, list[NamedSlat]] = {}
        for label, slat in _slats_of(object_id, slats, claims, claimed):
            labelled.setdefault(label, []).append(slat)
        if len(labelled) <= 1:
            labelled = {"": [slat for group in labelled.values() for slat in group]}
        samples = {grid.sample for grid in grids.get(object_id, ())} if each_sample else set()
        apart: list[str | None] = [*sorted(samples)] if len(samples) > 1 else [None]
        for (label, group), sample in product(labelled.items(), apart):
            parts = object_id, label, "" if sample is None else f"sample_{sample}"
            asset_id = encoded(".".join(filter(None, parts)))
            yield _Row(asset_id, object_id, label, ordered(group), sample)


def _slats_of(
    object_id: str,
    slats: Mapping[str, list[NamedSlat]],
    claims: Mapping[str, list[tuple[str, str]]],
    claimed: set[str],
) -> Iterator[tuple[str, NamedSlat]]:
    """Yield the SLATs of an object, each with a label that tells it from the object's others."""
    if object_id not in claims:
        if object_id not in claimed:
            for slat in slats.get(object_id, ()):
                yield slat.view, slat
        return
    several = len({slat_id for slat_id, _ in claims[object_id]}) > 1
    for slat_id, view in claims[object_id]:
        found = slats.get(slat_id, [])
        if view and any(slat.view for slat in found):
            found = [slat for slat in found if slat.view == view]
        for slat in found or [NamedSlat(slat_id, view, "")]:
            parts = (slat_id if several else "", slat.view)
            yield view or ".".join(part for part in parts if part), slat


def _pairs(rows: list[_Row], found: Sequence[_Found]) -> Iterator[AssetPair]:
    for asset_id, group in groupby(rows, key=lambda row: row.asset_id):
        same = list(group)
        shared = ""
        if len(same) > 1:
            names = " and ".join(
                f"object {row.object_id!r}" + (f" view {row.view!r}" if row.view else "")
                for row in same
            )
            shared = f"asset id {asset_id!r} would stand for {names}; rename one"
        yield _pair(same[0], found, shared)


def _pair(row: _Row, found: Sequence[_Found], shared: str) -> AssetPair:
    samples = found[0].source.samples
    there = found[0]
    if row.object_id not in there.grids:
        # What is damaged in a further source, such as an archive, may be there alone.
        told = (one for one in found for grid in one.grids.get(row.object_id, ()) if grid.problem)
        there = next(told, there)
    annotations = _annotations(row, there)
    if samples == "merge" and annotations:
        first, *others = [
            _pair_of(row, source, shared, grids)
            for source in found
            for grids in _annotations(row, source)
        ]
        return replace(first, others=tuple(others))
    chosen = annotations[:1] if samples == "first" else annotations
    return _pair_of(row, there, shared, list(chain.from_iterable(chosen)))


def _annotations(row: _Row, there: _Found) -> list[list[adapters.FoundField]]:
    """Return the grids of a row in groups by sample; `_pair_of` reports two grids of a sample."""
    grids = sorted(there.grids.get(row.object_id, ()), key=_order_of)
    groups = groupby(grids, key=lambda grid: grid.sample)
    return [list(group) for sample, group in groups if row.sample in (None, sample)]


def _order_of(found: adapters.FoundField) -> tuple[float, str, str]:
    """Return a sort key that orders samples by number if they have one: 10 comes after 2."""
    number = float(found.sample) if found.sample.isdecimal() else math.inf
    return number, found.sample, found.path


def _pair_of(
    row: _Row, there: _Found, shared: str, grids: Sequence[adapters.FoundField]
) -> AssetPair:
    source = there.source
    sides: tuple[adapters.FoundField | NamedSlat, ...] = (*grids, *row.slats)
    problems = [shared, *_name_problems(row, [repr(side.path) for side in sides if side.path])]
    for side in sides:
        problems += [side.problem, _unrecordable(side.path)]
    grid = mask = bounds = transform = None
    beside: tuple[Place, ...] = ()
    if grids:
        grid = there.roots.pixieverse / grids[0].path
        if len(grids) > 1 and not grids[0].problem:
            problems.append(adapters.several_grids(row.object_id, grids))
        if NAME.fullmatch(row.object_id):
            sample = grids[0].sample or source.sample
            known = {"id": row.object_id} | ({"sample": sample} if sample else {})
            if source.adapter == "pixieverse":
                # A mask that is named like the grid precedes a mask of all samples.
                own = grids[0].path.replace("_pred.npy", "_mask.npy")
                masks = sorted(source.mask, key=lambda pattern: fill(pattern, known) != own)
                mask = _find_one(there, masks, known, "mask", problems)
                bounds = _find_one(there, source.bounds, known, "bounds", problems)
            beside = tuple(there.roots.pixieverse / name for name in grids[0].beside)
            if source.transform:
                # A pattern without an id names one file for all assets.
                transform = _find_one(there, (source.transform,), known, "transform", problems)
                if transform is None:
                    tried = fill(source.transform, known)
                    problems.append(f"no transform for id {row.object_id!r}{LOOKED_FOR}{tried}")
    else:
        problems += _lacking(row, there, "no grid for id", _tried_grids(source, {"id": "{id}"}))
    found = [slat for slat in row.slats if slat.path]
    if not found and not any(grid.problem for grid in grids):
        problems += _lacking(row, there, NO_SLAT, _tried_slats(row, there))
    elif len(found) > 1:
        files = ", ".join(slat.path + (f" [{slat.group}]" if slat.group else "") for slat in found)
        problems.append(
            f"{len(found)} SLATs for one id {row.asset_id!r} ({files}); expected one, "
            "or a pattern with {view}"
        )
    number, sample = there.roots.number, in_unicode(grids[0].sample) if grids else ""
    # The label is unique among the object's annotations.
    label = filter(None, (f"also_{number}" if number else "", sample))
    return AssetPair(
        asset_id=row.asset_id,
        object_id=encoded(row.object_id),
        view=encoded(row.view),
        category=there.categories.get(row.object_id) or category_of(grid),
        roots=there.roots,
        grid=grid,
        mask=mask,
        bounds=bounds,
        slat=there.roots.slat / found[0].path if found else None,
        slat_group=found[0].group if found else "",
        problem="; ".join(dict.fromkeys(filter(None, problems))),
        transform=transform,
        beside=beside,
        sample=".".join(label),
    )


def _lacking(row: _Row, there: _Found, what: str, tried: str) -> Iterator[str]:
    """Say that a side is missing, and whether it has the id in another letter case."""
    yield f"{what} {row.object_id!r}{LOOKED_FOR}{tried}"
    if other := there.cases.get(row.object_id):
        yield f"a {what.split()[1]} is called {other!r}: rename one, or join them with --map"


def _name_problems(row: _Row, files: Sequence[str]) -> Iterator[str]:
    for kind, name in (("id", row.object_id), ("view", row.view)):
        if name and not NAME.fullmatch(name):
            plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).lstrip(".")[:40] or "a"
            yield (
                f"{kind} {encoded(name)[:300]!r} is not allowed: rename "
                f"{', '.join(files[:2]) or 'its files'}, to {plain!r} for instance. Take at most "
                "255 letters A to Z and a to z, digits, '.', '_' and '-', and begin with no '.'"
            )


def _unrecordable(path: str) -> str:
    if path == in_unicode(path):
        return ""
    return f"{path}: its name is no UTF-8, so that no record can hold it; rename it"


def _tried_grids(source: PixieverseSource, known: Mapping[str, str]) -> str:
    patterns = adapters.patterns_of(adapters.source_adapter(source.adapter), source)
    return tried_names(patterns, {**known, "sample": source.sample})


def _tried_slats(row: _Row, there: _Found) -> str:
    names = sorted({slat.slat_id for slat in row.slats} - {row.object_id}) or ["{id}"]
    if there.roots.slat != there.slat.root:
        groups = " or ".join(f"group {fill(there.slat.group, {'id': name})}" for name in names)
        return f"{groups} in {there.slat.root}"
    return "; ".join(tried_names(slat_patterns(there.slat), {"id": name}) for name in names)


def _find_one(
    there: _Found, patterns: Iterable[str], known: Mapping[str, str], role: str, problems: list[str]
) -> Place | None:
    """Return the file that the first matching pattern finds; add a problem if it finds several."""
    for pattern in patterns:
        found = sorted(find_files(there.listing, pattern, known), key=lambda one: one.path)
        problems += [one.problem or _unrecordable(one.path) for one in found]
        paths = [one.path for one in found if not one.problem]
        if len(paths) > 1:
            named = ", ".join(paths)
            problems.append(f"{len(paths)} {role} files for one id ({named}); expected one")
        if paths:
            return there.roots.pixieverse / paths[0]
    return None

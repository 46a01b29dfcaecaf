"""Notices to a person about a dataset, from the rows of a build."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from slatprep.align.consensus import find_consensus
from slatprep.errors import amount, first_of
from slatprep.judge import THRESHOLDS
from slatprep.normalize import PIXIE_RANGES
from slatprep.parameters import AlignParameters, BuildParameters
from slatprep.pipeline.rows import NextStore, moments_of, slat_contents
from slatprep.readers.contents import in_words, look_standardised, pooled_moments, tell_alone
from slatprep.readers.joins import explain_unmatched
from slatprep.readers.plausible import ENOUGH
from slatprep.readers.values import guess_in
from slatprep.records import AssetPair, Normalization, Verdict
from slatprep.store import Store
from slatprep.store.record import FailedRecord

# An asset is named if it alone widens a range by these decades, or by these widths of the rest.
_WILD_DECADES, _WILD_WIDTHS = 1.0, 9.0

_BESIDE_PIXIE = 0.5
"""Decades by which PixieVerse itself may exceed Pixie's published ranges."""

_TOLD = 100
"""Number of assets whose faults are told if no record tells them."""

_MOVED = 1e-6
"""Largest move of an end without a notice, as a share of its range: rounding moves it less."""

_MOST_CLIPPED = 0.25
"""Largest share of clipped values without a notice; usual percentiles clip a tenth or a fifth."""

_AT_BOUND = 1e-3
"""Largest distance from a bound, as a share of it, at which a scale counts as held by the bound."""


def nothing_usable(
    failed: Sequence[FailedRecord],
    parameters: BuildParameters,
    pairs: Collection[AssetPair] = (),
    replaces: bool = False,
) -> str:
    """Say why there is no store, or why one that `replaces` another is not written."""
    if unmatched := explain_unmatched(pairs, parameters):
        return f"{unmatched}. {'The store stays as it was' if replaces else 'There is no store'}"
    problems = [f"\n  {asset.asset_id}: {asset.reason}" for asset in failed]
    if not problems:
        return (
            f"no asset found in {parameters.pixieverse.root} and {parameters.slat.root}; "
            "expected files that match the patterns of the dataset definition"
        )
    more = f"\n  and {len(problems) - _TOLD:,} more" if len(problems) > _TOLD else ""
    so = "assets can be used, so there is no store"
    if replaces:
        so = "assets can be used, so the store stays as it was"
    return f"none of {len(problems):,} {so}:{''.join(problems[:_TOLD])}{more}"


def dataset_notices(
    new: NextStore, parameters: BuildParameters, failed: Sequence[FailedRecord] = ()
) -> Iterator[str]:
    """Yield what a person should know about the assets of a store as a whole."""
    yield from latent_warnings(new, parameters.slat.standardised)
    yield from at_scale_bounds(new, parameters.align)
    if not (parameters.consensus.settle or parameters.pixieverse.samples == "merge"):
        yield from shared_rotation(new)
    made = {row.asset_id: str(row.columns["unusual"]) for row in new.rows if row.spooled}
    yield from unusual_sources(made, failed)
    yield from shared_sources(new, "SLAT", slat_contents(new))
    # Rows that lie in another store have no column ``grid``.
    yield from shared_sources(new, "grid", [row.columns.get("grid") for row in new.rows])
    if new.normalization.source == "dataset" and any(row.spooled for row in new.rows):
        objects = list(map(str, new.column("object_id")))
        yield from wild_ranges(new.ids, objects, new.column("extent"), new.normalization)


def much_clipped(store: Store) -> Iterator[str]:
    """Yield a notice on each range that clips many values of a store, or most of an asset."""
    valid = store.column("valid_share") * np.diff(store.offsets)
    for span, counts in zip(store.normalization.ranges, store.column("clipped").T, strict=True):
        lost = [store.ids[row] for row in np.flatnonzero(counts > 0.5 * valid)]
        count, whole = counts.sum(), valid.sum()
        if lost or count > _MOST_CLIPPED * whole:
            unit = ", in log10 of the SI value," if span.log10 else ""
            some = f". They are most values of {_of_assets(lost, store.ids)}"
            yield (
                f"{100 * count / whole:.3g}% of the values of {span.name} are beyond its "
                f"range{unit} {span.lo:.4g} to {span.hi:.4g}, and were set to the end of it: see "
                f"normalize.ranges{some if 0 < len(lost) < len(store) else ''}"
            )


def at_scale_bounds(new: NextStore, parameters: AlignParameters) -> Iterator[str]:
    """Yield a notice if the search could not give assets the scale that they may need."""
    low, high = parameters.scale_bounds
    scales = np.cbrt(np.linalg.det(new.column("transform")[:, :3, :3]))
    # A scale of one needs no search, even if it is a bound.
    bounds = [bound for bound in (low, high) if bound != 1.0]
    ends = np.isclose(scales[:, None], bounds, rtol=_AT_BOUND).any(axis=1)
    if parameters.engine != "known" and ends.any():
        held = _of_assets([new.ids[row] for row in np.flatnonzero(ends)], new.ids)
        yield (
            f"the scale of {held} is at an end of align.scale_bounds, {low:g} to {high:g}, and "
            "probably beyond it: compare the sizes of the two sides, or give wider bounds"
        )


def moved_ranges(new: Normalization, before: Mapping[str, Normalization]) -> Iterator[str]:
    """Yield a notice on ends of ranges that moved; `before` has older ranges, by where they are."""
    moved = {}
    for where, old in before.items():
        spans = {one.name: one for one in old.ranges}
        ends = [
            f"{end} of {span.name}{' (log10)' * span.log10} from {was:.8g} to {now:.8g}"
            for span in new.ranges
            for end in ("lo", "hi")
            for was, now in [(getattr(spans.get(span.name, span), end), getattr(span, end))]
            if abs(now - was) > _MOVED * (span.hi - span.lo)
        ]
        if ends:
            moved[where] = ", ".join(ends)
    if moved:
        where, told = next(iter(moved.items()))
        more = f" (and {amount(len(moved) - 1, 'other store')})" if len(moved) > 1 else ""
        yield (
            f"the ranges are not those of {where}{more}: {told}. All of voxel/properties are on "
            "the new scale: train anew, or give fixed ranges with --ranges"
        )


def unusual_sources(told: Mapping[str, str], failed: Sequence[FailedRecord] = ()) -> Iterator[str]:
    """Yield one notice for each kind of unusual sources, with what refused values look like.

    `told` has ``asset/unusual`` of all assets by id. The records have the details of each asset.
    """
    odd: dict[str, dict[str, str]] = defaultdict(dict)
    for asset_id, lines in told.items():
        for kind, _, text in (line.partition(": ") for line in lines.splitlines()):
            odd[kind][asset_id] = text
    for kind, texts in sorted(odd.items()):
        also = ""
        if kind == "values":
            refused = Counter(guess for one in failed if (guess := guess_in(one.reason)))
            for unit, count in refused.most_common(1):
                these = "these" if len(texts) > 1 else "this"
                also = f"; {count} refused assets look like {unit}, and {these} probably too"
        first, text = next(iter(texts.items()))
        whose = f"of {first}: " if len(texts) > 1 else ""
        yield f"{kind} of {_of_assets(list(texts), told)} are unusual: {whose}{text}{also}"


def stored_oddities(store: Store) -> list[str]:
    """Return notices on unusual and shared sources of a store's assets, and on clipped values."""
    told = dict(zip(store.ids, store.column("unusual"), strict=True))
    shared = shared_sources(store, "SLAT", slat_contents(store))
    return [*unusual_sources(told), *shared, *much_clipped(store)]


def shared_rotation(new: NextStore) -> Iterator[str]:
    """Yield a notice if a consensus may settle ties of new assets, as most others turn alike."""
    tied = new.column("ambiguity") > THRESHOLDS.good_ambiguity
    if not any(row.spooled for row, ties in zip(new.rows, tied, strict=True) if ties):
        return
    sure = ~tied & (new.column("verdict") != Verdict.FAILED)
    if common := find_consensus(new.column("transform")[sure], new.column("object_id")[sure]):
        yield (
            f"{tied.sum():,} of {len(tied):,} assets have other placements that fit about as well, "
            f"and {common.agreeing:,} of {common.winners:,} other objects share a rotation: "
            "--consensus takes that where it is likelier"
        )


def shared_sources(
    store: NextStore | Store, what: str, contents: Sequence[object]
) -> Iterator[str]:
    """Yield a notice if objects share a source; `contents` identify it, empty if unknown."""
    found: defaultdict[object, list[int]] = defaultdict(list)
    for at, content in enumerate(contents):
        if content:
            found[content].append(at)
    ids, objects = store.ids, store.column("object_id")
    if groups := [own for own in found.values() if len({objects[at] for at in own}) > 1]:
        names = [" = ".join(ids[at] for at in own[:4]) for own in groups]
        yield (
            f"{sum(map(len, groups))} assets of different objects share the same {what} "
            f"({first_of(names)}): see whether a map or a copy gave it to both"
        )


def wild_ranges(
    ids: Sequence[str],
    objects: Sequence[str],
    extents: NDArray[np.float64],
    normalization: Normalization,
) -> Iterator[str]:
    """Yield a notice on each asset whose object alone makes a range 10 times wider.

    `extents` are (A, P, 2) in mapped units. With two objects, either may be the wrong one.
    """
    if len(set(objects)) < 3:
        return
    usual = {one.name: one for one in PIXIE_RANGES.ranges}
    for column, span in enumerate(normalization.ranges):
        for end, sign in ((0, -1.0), (1, 1.0)):
            values = sign * extents[:, column, end]
            if not np.isfinite(values).all():
                continue
            last = int(np.argmax(values))
            elsewhere = [one != objects[last] for one in objects]
            own, others = float(values[last]), extents[elsewhere, column]
            beside = float((sign * others[:, end]).max())
            width = max(float(others[:, 1].max() - others[:, 0].min()), 1e-12)
            if own - beside < (_WILD_DECADES if span.log10 else _WILD_WIDTHS * width):
                continue
            known = usual.get(span.name)
            if known and own <= max(sign * known.lo, sign * known.hi) + _BESIDE_PIXIE:
                continue
            times = 10.0 ** (own - beside) if span.log10 else 1 + (own - beside) / width
            ends = [10.0**at if span.log10 else at for at in (sign * own, sign * beside)]
            yield (
                f"{ids[last]} alone makes the range of {span.name} {times:.3g} times wider: it has "
                f"{ends[0]:.3g}, all others end at {ends[1]:.3g}. Look at its source, or give "
                "normalize.ranges"
            )


def _of_assets(names: Sequence[str], every: Collection[str]) -> str:
    return f"{len(names):,} of {len(every):,} assets ({first_of(names)})"


def latent_warnings(new: NextStore, standardised: str) -> Iterator[str]:
    """Yield notices on whether the latents of a store are standardised."""
    latents = new.contents.latents
    moments = moments_of(new.rows, new.stores)
    known = [(row, own) for row, own in zip(new.rows, moments, strict=True) if own]
    looks = {
        row.asset_id: look_standardised(own, latents)
        for row, own in known
        if row.n_voxels >= ENOUGH and tell_alone(own, latents)
    }
    if latents.standardised and standardised == "auto":
        pooled = pooled_moments([(row.n_voxels, own) for row, own in known])
        yield (
            f"the latents look standardised already ({in_words(pooled)}) and are marked so; say "
            'standardised = "yes" in [slat] of a --config FILE if they are, "no" if not'
        )
    others = [name for name, look in looks.items() if look != latents.standardised]
    if others and standardised != "no":
        how = "as the encoder gives them" if latents.standardised else "standardised already"
        why = "unlike the others: look where they come from"
        if standardised == "yes" and len(others) == len(looks):
            why = 'and slat.standardised is "yes": is that so?'
        yield f"the latents of {_of_assets(others, new.ids)} look {how}, {why}"

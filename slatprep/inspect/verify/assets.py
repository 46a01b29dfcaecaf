"""Verify an asset's values against their ranges, its grid and its record."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import orjson
from numpy.typing import NDArray

from slatprep.errors import InputError, SlatprepError, StoreError
from slatprep.geometry.deformation import map_of
from slatprep.geometry.voxels import flat_index
from slatprep.inspect.check import TOLERANCES, recompute_annotation
from slatprep.judge import voxel_confidence
from slatprep.judge.evidence import labels_hold
from slatprep.normalize import normalize_change, normalize_properties
from slatprep.pipeline.annotate import annotate
from slatprep.pipeline.fingerprint import code_fingerprint
from slatprep.pipeline.rows import PLACE_TOLERANCE, SourceStore
from slatprep.readers import read_field
from slatprep.readers.files import is_hierarchy, load_source
from slatprep.records import (
    LATENT_ROLES,
    UNANNOTATED,
    Annotation,
    AssetPair,
    Contribution,
    Model,
    Normalization,
    Place,
    SourceRoots,
    table_of,
)
from slatprep.sample import in_table, merge
from slatprep.storage.files import file_digest
from slatprep.storage.place import storage_of
from slatprep.store.contract import Finding
from slatprep.store.layout import RECORD_ARRAY
from slatprep.store.reader import StoredAsset
from slatprep.store.record import AssetRecord
from slatprep.store.record_json import RecordError, columns_of, digest_of
from slatprep.store.shard_reader import DamagedFileError, UnreachableError

CONFIDENCE_TOLERANCE = 1e-5
"""Largest allowed difference of probabilities, shares and normalised spreads: machines may
round sums differently."""


def asset_findings(
    source: SourceStore, row: int, roots: Sequence[SourceRoots]
) -> tuple[list[Finding], int]:
    """Return the faults of an asset of a store, and the number of its sources compared.

    Sources are compared only if `roots` are given.
    """
    asset_id, findings, compared = source.ids[row], list[Finding](), 0
    where, expected = "asset", "an asset that can be read"
    try:
        asset = source.asset(row)
        findings += list(value_findings(asset)) or lookup_findings(asset)
        sound = not findings
        where, expected = RECORD_ARRAY, "a record for each row"
        record = source.records.read(row)
        findings += record_findings(asset, record, source.text(row))
        if sound:  # Confidence cannot be computed from invalid values.
            findings += confidence_findings(asset, record)
        if roots:
            where, expected = "sources", "those that the store was made from"
            changed, compared = list(source_findings(record, roots, source)), len(record.sources)
            findings += changed
            if record.merged and sound and not changed:
                findings += merged_findings(asset, record, roots)
    except UnreachableError:
        raise
    except DamagedFileError as error:
        findings.append(Finding(error.file, asset_id, error.fault, error.expected))
    except RecordError as error:
        findings += fault_findings(RECORD_ARRAY, asset_id, error)
    except StoreError as error:
        findings.append(Finding(where, asset_id, str(error), expected))
    return findings, compared


def value_findings(asset: StoredAsset) -> Iterator[Finding]:
    """Yield findings on values that the contract does not allow."""
    if not len(asset.coords):
        yield Finding("asset/offset", asset.asset_id, "no voxels", "one or more")
        return
    valid, material, grid, votes = asset.valid, asset.material, asset.grid_material, asset.votes
    contents, likely = asset.store.contents, asset.confidence
    classes, empty = contents.n_labels, contents.background
    known = np.isin(np.arange(256), (*range(classes), empty, UNANNOTATED))
    last, unfit = classes - 1, "a property that does not go with"
    values: tuple[tuple[str, bool | np.bool_, str, str], ...] = (
        ("voxel/coords", (np.diff(np.sort(flat_index(asset.coords, 256))) > 0).all(),
         "a coordinate occurs twice", "each once"),
        ("voxel/feats", np.isfinite(asset.feats).all(), "NaN or infinite", "finite latents"),
        ("voxel/material", np.where(valid, material < classes, material == UNANNOTATED).all(),
         "a class that does not go with valid", f"0 to {last} where valid, 255 elsewhere"),
        ("voxel/properties", _normalised(asset.properties.T, valid),
         f"{unfit} valid", "-1 to 1 where valid, NaN elsewhere"),
        ("voxel/distance", (asset.distance >= 0).all(),
         "negative or NaN", "a distance of 0 or more"),
        ("voxel/place", np.isfinite(asset.place).all(), "NaN or infinite", "finite points"),
        ("voxel/confidence", ((likely >= 0) & (likely <= valid)).all(),
         "no probability, or one where there is no class", "0 to 1 where valid, 0 elsewhere"),
        ("voxel/spread", _is_spread(asset),
         "negative, or there where fewer than two annotations are",
         "0 or more for all properties or NaN for all"),
        ("voxel/votes", not asset.merged or (((votes > 0) == valid) & (votes <= 1)).all(),
         "no share, or one where there is no class", "above 0 to 1 where valid, 0 elsewhere"),
        ("grid/material", known[grid].all(),
         "an unknown class", f"0 to {last}, {empty} or 255"),
        ("grid/properties", _normalised(asset.grid_properties, grid < classes),
         f"{unfit} grid/material", "-1 to 1 where annotated, NaN elsewhere"),
    )  # fmt: skip
    for where, fine, what, expected in values:
        if not fine:
            yield Finding(where, asset.asset_id, what, expected)


def lookup_findings(asset: StoredAsset) -> Iterator[Finding]:
    """Yield findings where the annotation differs from a new lookup by grid and places."""
    try:
        _, differences = recompute_annotation(asset)
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as error:
        yield Finding("asset", asset.asset_id, f"cannot be sampled ({error})", "sound parameters")
        return
    for where, difference in differences.items():
        expected = "what the grid, the places and the parameters give"
        yield from _voxel_findings(asset, where, difference <= TOLERANCES[where], expected)


def _voxel_findings(
    asset: StoredAsset, where: str, fine: NDArray[np.bool_], expected: str
) -> Iterator[Finding]:
    """Yield a finding unless `fine` (N, ...) is true for all voxels."""
    wrong = np.count_nonzero(~fine.all(axis=tuple(range(1, fine.ndim))))
    if wrong:
        yield Finding(where, asset.asset_id, f"{wrong} of {len(fine)} voxels differ", expected)


def fault_findings(where: str, asset_id: str, error: RecordError) -> list[Finding]:
    """Return at most three faults of a record that cannot be read."""
    return [Finding(where, asset_id, fault, "the published schema") for fault in error.faults[:3]]


def record_findings(asset: StoredAsset, record: AssetRecord, text: bytes) -> Iterator[Finding]:
    """Yield findings where an asset's record disagrees with its row or its stored places."""
    if digest_of(text) != bytes(asset.store.cached_column("record_sha256")[asset.index]):
        what = "is not what asset/record_sha256 is of"
        yield Finding(RECORD_ARRAY, asset.asset_id, what, "the record of the build")
    for name, said, held in _claims(asset, record):
        if not _equal(said, held):
            what, expected = f"{name} is {said!r}", f"{held!r}, as the store has"
            yield Finding(RECORD_ARRAY, asset.asset_id, what, expected)
    if bool(record.merged) != asset.merged:
        what = f"merges {len(record.merged)} annotations"
        expected = "several, as voxel/votes says" if asset.merged else "none, as voxel/votes says"
        yield Finding(RECORD_ARRAY, asset.asset_id, what, expected)
    alignment = record.alignment
    bends = alignment.model in (Model.AFFINE, Model.DEFORMABLE)
    if bends != (alignment.deformation is not None):
        what = f"model is {str(alignment.model)!r}, {'without' if bends else 'with'} a deformation"
        yield Finding(RECORD_ARRAY, asset.asset_id, what, "one where it is affine or deformable")
    places = map_of(alignment).to_pixieverse(asset.latents.centres)
    fine = np.abs(places - asset.place) <= PLACE_TOLERANCE
    yield from _voxel_findings(asset, "voxel/place", fine, "where the map in the record leads")


def confidence_findings(asset: StoredAsset, record: AssetRecord) -> Iterator[Finding]:
    """Yield a finding if ``voxel/confidence`` differs from its value by grid and record."""
    if asset.merged:
        return
    field, properties = asset.normalised_field, asset.properties
    # The confidence comes from classes alone, if there are any and nothing ties.
    tied = bool(record.alignment.placements)
    if tied or not field.classified:
        if asset.store.cached_column("clipped_grid")[asset.index].any():
            return  # The confidence came from values that the store does not hold.
        field, properties = asset.field, asset.properties_si
    annotation = Annotation(properties, asset.material, asset.valid, asset.distance, asset.place)
    if not labels_hold(field, annotation, roundings(asset.store.normalization), tied):
        return  # The confidence may come from other labels than the rounded values give.
    given = record.alignment, annotation, record.parameters.sample, record.judgement.confidence
    likely = voxel_confidence(field, asset.latents, *given)
    fine = np.abs(likely - asset.confidence) <= CONFIDENCE_TOLERANCE
    expected = "what the grid, the places and the record give"
    if record.code != code_fingerprint():
        expected += " by today's code; another made the store, and building it again helps"
    yield from _voxel_findings(asset, "voxel/confidence", fine, expected)


def source_findings(
    record: AssetRecord, roots: Sequence[SourceRoots], store: SourceStore
) -> Iterator[Finding]:
    """Yield findings on sources that are missing or differ from the record."""
    for source in record.sources:
        if source.source >= len(roots):
            what = f"{source.path} is of {table_of(source.source)}, whose root is not known"
            yield Finding("sources", record.asset_id, what, "its root, by --also")
            continue
        own = roots[source.source]
        root = own.slat if source.role in LATENT_ROLES else own.pixieverse
        path = root / source.path
        expected = f"SHA-256 {source.sha256}"
        try:
            if is_hierarchy(path):
                found = load_source(path, root, source.role)[1]
                size, digest = found.size, found.sha256
            else:
                file, _ = storage_of(root).locate(path)
                size = storage_of(file).size()
                digest = _digest(file, store.run) if size == source.size else ""
            what = "" if digest == source.sha256 else "its bytes changed"
            if size != source.size:
                what = f"has {size} of {source.size} bytes"
        except InputError as error:
            what = error.fault
        except OSError as error:
            what = f"cannot be read ({error.strerror})"
        if what:
            yield Finding(str(path), record.asset_id, what, expected)


def merged_findings(
    asset: StoredAsset, record: AssetRecord, roots: Sequence[SourceRoots]
) -> Iterator[Finding]:
    """Yield findings where merged labels differ from a new merge by sources and alignments."""
    latents, contents = asset.latents, asset.store.contents
    parts = []
    for one in record.contributions:
        if one.left_out or one.alignment is None or one.judgement is None:
            continue
        try:
            pair = _pair_of(asset, record, one, roots)
            field = read_field(pair, record.parameters.sample.max_unphysical)
        except (IndexError, SlatprepError) as error:
            where = f"sample {one.sample} cannot be looked up again ({error})"
            yield Finding("sources", asset.asset_id, where, "the sources of the build")
            return
        placed = annotate(pair, field, latents, record.parameters, one.alignment, one.judgement)
        parts.append(in_table(placed.annotation, field, contents))
    if not parts:
        yield Finding("asset/record", asset.asset_id, "merges no annotation", "one at least")
        return
    made = merge(parts, contents.properties)
    ranges = asset.store.normalization
    spread = None if made.spread is None else normalize_change(made.spread, ranges)
    properties = normalize_properties(made.properties, ranges)
    now = vars(made) | {"properties": properties, "spread": spread}
    for name in ("valid", "material", "properties", "confidence", "spread", "votes"):
        limit = TOLERANCES.get(f"voxel/{name}", CONFIDENCE_TOLERANCE)
        held, given = getattr(asset, name), np.asarray(now[name], dtype=np.float64)
        same = np.isclose(held, given, rtol=0.0, atol=limit, equal_nan=True)
        yield from _voxel_findings(asset, f"voxel/{name}", same, "what the sources give, merged")


def _pair_of(
    asset: StoredAsset, record: AssetRecord, one: Contribution, roots: Sequence[SourceRoots]
) -> AssetPair:
    """Return the pair of one annotation, with the present places of its files."""
    found = [record.sources[k] for k in one.sources]
    own = roots[found[0].source]
    files = {file.role: own.pixieverse / file.path for file in found}
    slat = next(own.slat / file.path for file in record.sources if file.role == "slat")
    return AssetPair(
        record.asset_id,
        record.object_id,
        record.view,
        record.category,
        replace(own, contents=asset.store.contents),
        files.get("grid"),
        files.get("mask"),
        files.get("bounds"),
        slat,
        transform=files.get("transform"),
        beside=tuple(own.pixieverse / file.path for file in found if file.role == "description"),
        sample=one.sample,
    )


def roundings(normalization: Normalization) -> NDArray[np.float64]:
    """Return the largest rounding error (P,) of a mapped property that went through the store.

    Values are rounded to float32 twice, normalised and in SI units, each by at most 2**-24 of the
    value. If a property is mapped by log10, its exponent changes by less than half of that.
    """
    spans = normalization.ranges
    own = [0.5 if span.log10 else max(abs(span.lo), abs(span.hi)) for span in spans]
    wide = [0.5 * (span.hi - span.lo) for span in spans]
    return np.add(wide, own) * 2.0**-24


def _is_spread(asset: StoredAsset) -> bool:
    """Return whether spreads are at least 0, and NaN unless labels are merged and valid."""
    missing = np.isnan(asset.spread)
    may = asset.valid & asset.merged
    return bool(missing[~may].all() and (missing | (asset.spread >= 0)).all())


def _normalised(values: NDArray[np.float32], where: NDArray[np.bool_]) -> bool:
    """Return whether values (..., rows) are in [-1, 1] where the mask is true, else NaN."""
    there = values.reshape(-1, where.size)[:, np.flatnonzero(where)]
    missing = np.count_nonzero(np.isnan(values))
    return bool((np.abs(there) <= 1).all()) and missing == values.size - there.size


def _claims(asset: StoredAsset, record: AssetRecord) -> Iterator[tuple[str, object, object]]:
    """Yield name, value in the record and value in the store of each entry that both have."""
    store = asset.store
    yield "asset_id", record.asset_id, asset.asset_id
    columns = columns_of(record)
    change = columns["property_ambiguity"]
    # A faulty record may have a wrong number of properties.
    if len(change) == len(store.normalization.ranges):
        columns["property_ambiguity"] = normalize_change([change], store.normalization)[0]
    for name, column in columns.items():
        yield name, column, store.cached_column(name)[asset.index]
    grid, background = asset.grid_material, store.contents.background
    for name, count in (
        ("slat_voxels", len(asset.coords)),
        ("valid", asset.valid.sum()),
        ("annotated", (grid < background).sum()),
        ("unannotated", (grid == UNANNOTATED).sum()),
        ("occupied", (grid != background).sum()),
    ):
        yield f"counts/{name}", getattr(record.counts, name), int(count)
    parameters = store.attributes["build"]["parameters"]
    for name in ("align", "sample"):
        given = orjson.loads(orjson.dumps(getattr(record.parameters, name)))
        yield f"parameters/{name}", given, parameters.get(name)


def _equal(said: object, held: object) -> bool:
    """Return whether values or arrays are equal; a scalar is compared with every channel."""
    one, other = np.asarray(said), np.asarray(held)
    if one.ndim and one.shape != other.shape:
        return False
    return bool(((one == other) | ((one != one) & (other != other))).all())


@lru_cache(maxsize=64)
def _digest(path: Place, _run: str) -> str:
    # Cached, because one file may hold the SLATs of many assets. The run is part of the cache's
    # key, because files may change between two verifications.
    return file_digest(path)

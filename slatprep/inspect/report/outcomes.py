"""What the records of a build say about each asset that its store does not."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from slatprep.errors import StoreError
from slatprep.records import Place, Status


@dataclass(frozen=True)
class Outcome:
    """What became of one asset.

    Attributes
    ----------
    asset_id, category : str
        Of its record.
    status : Status
        ``ok`` where it is in the store.
    reasons : tuple of str
        Why it is not in the store, or why its verdict is not ``good``.
    tied : int
        Distinct placements that fit about as well as the best.
    displacement : float or None
        Largest distance [voxel] between the best placement and a tied one;
        None where there is none.
    clipped : tuple of int
        Values of ``voxel/properties`` outside the range, by property.
    """

    asset_id: str
    category: str
    status: Status
    reasons: tuple[str, ...]
    tied: int
    displacement: float | None
    clipped: tuple[int, ...]


def read_outcomes(manifests: Place, manifest: str) -> Iterator[Outcome]:
    """Yield the outcome of every asset of a build, in the order of its records.

    Parameters
    ----------
    manifests : Path
        Directory of ``assets.jsonl`` and ``build.json``.
    manifest : str
        Id of the build that wrote the store.

    Raises
    ------
    StoreError
        If the records cannot be read or belong to another build.
    """
    found = _document(manifests / "build.json", _read(manifests / "build.json")).get("id")
    if found != manifest:
        raise StoreError(
            f"{manifests} holds the records of build {str(found)[:12]!r}, the store was written by "
            f"{manifest[:12]!r}; name the folder of its own records with --manifests"
        )
    path = manifests / "assets.jsonl"
    try:
        with path.open("r", encoding="utf-8") as lines:
            for number, line in enumerate(lines, start=1):
                where = f"{path}, line {number}"
                try:
                    yield _outcome(_document(where, line))
                except (KeyError, TypeError, ValueError) as error:
                    raise StoreError(f"{where}: not a record of an asset ({error!r})") from error
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"{path}: cannot be read ({error})") from error


def kind_of(reason: str) -> str:
    """Return a reason without what is special to one asset: its file and its numbers.

    Examples
    --------
    >>> kind_of("only 76.1% of the SLAT boundary lies within 1 voxel of the other side")
    'only N% of the SLAT boundary lies within N voxel of the other side'
    >>> kind_of("a/b.npz: holds 3 voxels twice; expected distinct coordinates")
    'holds N voxels twice'
    """
    kind = reason.partition("; expected")[0]
    kind = re.sub(r"^\S*[/\\.]\S*: ", "", kind)
    return re.sub(r"\d[\d,]*(\.\d+)?(e[-+]?\d+)?", "N", kind)


def _read(path: Place) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise StoreError(f"{path}: cannot be read ({error})") from error


def _document(where: Place | str, text: str) -> dict[str, Any]:
    try:
        document = json.loads(text)
    except ValueError as error:
        raise StoreError(f"{where}: no JSON document ({error})") from error
    if not isinstance(document, dict):
        raise StoreError(f"{where}: expected a JSON object, found {type(document).__name__}")
    return document


def _outcome(record: dict[str, Any]) -> Outcome:
    alignment = record["alignment"]
    placements = alignment["placements"] if alignment else []
    displacements = [float(placement["displacement"]) for placement in placements]
    reasons = alignment["verdict_reasons"] if alignment else [record["reason"]]
    clipped = ((record["counts"] or {}).get("clipped") or {}).get("voxel", {})
    return Outcome(
        asset_id=str(record["asset_id"]),
        category=str(record["category"]),
        status=Status(record["status"]),
        reasons=tuple(str(reason) for reason in reasons),
        tied=len(placements),
        displacement=max(displacements, default=None),
        clipped=tuple(int(count) for count in clipped.values()),
    )

"""What the records say of an asset's search: the starts and how well each fitted."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from slatprep.errors import StoreError
from slatprep.records import Candidate, Place
from slatprep.store.reader import Store


def candidates_of(
    store: Store, asset_ids: Sequence[str], manifests: Path | None = None
) -> dict[str, tuple[Candidate, ...] | str]:
    """Return the candidates of assets from their records.

    They are looked for in the store itself (``asset/record``), else in the
    ``assets.jsonl`` of the build that made it.

    Parameters
    ----------
    store : Store
        The store.
    asset_ids : sequence of str
        Which assets.
    manifests : Path, optional
        Folder of the build's records; by default the usual places are tried,
        see `usual_manifests`.

    Returns
    -------
    dict
        The candidates of each asset by id; in their place, in words, why they
        are not known.

    Raises
    ------
    StoreError
        If the folder that was named holds no records of this store's build.
    """
    if "asset/record" in store.group:
        array: Any = store.group["asset/record"]
        texts = {asset_id: str(array[store.find(asset_id)]) for asset_id in asset_ids}
        return {asset_id: _candidates(json.loads(text)) for asset_id, text in texts.items()}
    if manifests is not None:
        if not _made(manifests, store):
            raise StoreError(
                f"{manifests} holds no records of the build that made {store.path}; expected "
                f"build.json with the id {store.attributes['manifest']!r}, and assets.jsonl"
            )
        folder: Place | None = manifests
    else:
        folder = next((place for place in usual_manifests(store.path) if _made(place, store)), None)
    if folder is None:
        unknown = "not known: the records of this build were not found; --manifests names them"
        return dict.fromkeys(asset_ids, unknown)
    found = {record["asset_id"]: _candidates(record) for record in _records(folder, asset_ids)}
    return {name: found.get(name, "not known: the records leave it out") for name in asset_ids}


def usual_manifests(store: Place) -> tuple[Place, ...]:
    """Return where a build's records lie: beside the store, or where `make align` puts them."""
    name = store.name.removesuffix(".zarr")
    made = f"manifests/build/{name}"
    return (
        store.with_name(f"{name}.manifests"),
        store.absolute().parent.parent / made,
        Path(made),
    )


def _made(folder: Place, store: Store) -> bool:
    """Whether a folder's records are those of the build that made the store."""
    try:
        build = json.loads((folder / "build.json").read_text("utf-8"))
    except (OSError, ValueError):
        return False
    same = isinstance(build, dict) and build.get("id") == store.attributes.get("manifest")
    return same and (folder / "assets.jsonl").is_file()


def _records(folder: Place, asset_ids: Sequence[str]) -> Iterator[dict[str, Any]]:
    # Parsing a record takes a hundred times as long as seeing that it is another's.
    mark, decoder, wanted = '"asset_id":', json.JSONDecoder(), set(asset_ids)
    with (folder / "assets.jsonl").open("r", encoding="utf-8") as lines:
        for line in lines:
            asset_id, _ = decoder.raw_decode(line, line.index(mark) + len(mark))
            if asset_id in wanted:
                yield json.loads(line)


def _candidates(record: dict[str, Any]) -> tuple[Candidate, ...] | str:
    entries = (record.get("alignment") or {}).get("candidates") or []
    if not entries:
        return "not known: the engine did not keep them"
    return tuple(
        Candidate(
            index=int(entry["index"]),
            euler_degrees=tuple(entry["euler_degrees"]) if entry["euler_degrees"] else None,
            fitness=float(entry["fitness"]),
            inlier_rmse=float(entry["inlier_rmse"]),
            same_as=entry["same_as"],
        )
        for entry in entries
    )

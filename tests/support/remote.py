"""Stores put on S3, and what is in sight there."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slatprep.parameters import StoreParameters
from slatprep.pipeline.dataset import build_store
from slatprep.storage.place import place_of
from slatprep.storage.upload import published_state, upload_store
from support import synthetic
from support.trees import contents


class Dataset(synthetic.Dataset):
    """A dataset whose store is fewer objects: a server takes 10 ms for each."""

    shards = StoreParameters(512, 4, 2, 1)


Made = tuple[Dataset, Path]


def built(folder: Path, *ids: str, seed: int = 0) -> Made:
    """Make assets, and a store of them."""
    dataset = Dataset(folder / "sources").having(*ids, seed=seed)
    build_store(dataset.parameters("pixie"), folder / "s.zarr")
    return dataset, folder / "s.zarr"


def few_files(folder: Path, content: str) -> Path:
    """Make a folder that an upload takes for a store, as it looks into no file."""
    folder.mkdir()
    for name in ("zarr.json", "voxel.json"):
        (folder / name).write_text(content)
    return folder


def raising(
    error: Exception, method: Any = None, where: Callable[[str, Any], bool] = lambda *_: True
) -> Callable[..., Any]:
    """Return what a method of a client is that fails where path and options are such."""

    async def raises(client: Any, path: str, *given: Any, **options: Any) -> Any:
        if where(path, options):
            raise error
        return await method(client, path, *given, **options)

    return raises


def put(store: Path, url: str) -> Path:
    """Publish a finished store; return where its version lies."""
    made = upload_store(store, published_state(place_of(url)))
    made.publish()
    return made.version


def current(s3: Any, url: str) -> dict[str, str]:
    """Return what is in sight: the hashes of the version that the pointer names."""
    pointer = json.loads(s3.cat_file(f"{url}/current.json"))
    return contents(s3, f"{url}/versions/{pointer['version']}")


def versions(s3: Any, url: str) -> set[str]:
    return {name.split("/")[1] for name in contents(s3, url) if name.startswith("versions/")}

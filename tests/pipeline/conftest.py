"""The published dataset, in archives and unpacked, and the store of it."""

from pathlib import Path

import pytest
from support.published import files, make_published, parameters

from slatprep.pipeline.dataset import build_store


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_published(tmp_path_factory.mktemp("published"))


@pytest.fixture(scope="session")
def unpacked(made: Path) -> dict[str, bytes]:
    """Return the files of the store of the unpacked folder."""
    wanted = parameters(made, "pixieverse/render_outputs", categories=True)
    build_store(wanted, made / "unpacked.zarr")
    return files(made / "unpacked.zarr")

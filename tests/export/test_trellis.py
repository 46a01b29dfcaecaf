"""An npz export is a root that TRELLIS's structured-latent data set loads."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas
import pytest
from support.exports import index_of
from support.synthetic import JELLY, METAL

from slatprep.errors import ConfigError
from slatprep.export import ExportOptions, export_store

ENCODER = "dinov2_vitl14_reg_slat_enc_swin8_B_64l8_fp16"  # latent_model of TRELLIS's configurations


class StructuredLatents:
    """What TRELLIS's data set does with a root, by the documentation of its columns.

    A row of ``metadata.csv`` is an asset. Those are taken that have latents of
    the model, a score of at least the least one and at most as many voxels as
    allowed; the file is found by ``sha256``, the load of a batch by
    ``num_voxels``.
    """

    def __init__(
        self, root: Path, model: str, least_score: float = 5.0, most_voxels: int = 32768
    ) -> None:
        table = pandas.read_csv(root / "metadata.csv")
        table = table[table[f"latent_{model}"]]
        table = table[table["aesthetic_score"] >= least_score]
        table = table[table["num_voxels"] <= most_voxels]
        self.names = list(table["sha256"])
        self.loads = [table.set_index("sha256").loc[name, "num_voxels"] for name in self.names]
        self.folder = root / "latents" / model

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        with np.load(self.folder / f"{self.names[index]}.npz") as data:
            return data["coords"].astype(np.int32), data["feats"].astype(np.float32)


@pytest.mark.parametrize("model", ["", "my_encoder.v2"])
def test_an_npz_export_is_what_trellis_loads(model, store, mixed, tmp_path):
    options = ExportOptions(latent_model=model) if model else ExportOptions()
    export_store(store, tmp_path / "root", "npz", options=options)
    loaded = StructuredLatents(tmp_path / "root", model or ENCODER)
    assert loaded.names == sorted(mixed.assets)
    for index, name in enumerate(loaded.names):
        coords, feats = loaded[index]
        np.testing.assert_array_equal(coords, mixed.assets[name].coords)
        np.testing.assert_array_equal(feats, mixed.assets[name].feats)
        assert loaded.loads[index] == len(coords)
    most = sorted(loaded.loads)[2]
    assert len(StructuredLatents(tmp_path / "root", model or ENCODER, 9.0, most).names) == sum(
        load <= most for load in loaded.loads
    )


def test_the_targets_lie_beside_the_latents(store, mixed, tmp_path):
    export_store(store, tmp_path / "root", "npz")
    for asset_id, asset in mixed.assets.items():
        with np.load(tmp_path / "root" / "latents" / ENCODER / f"{asset_id}.npz") as data:
            assert sorted(data) == ["coords", "feats", "material", "properties", "valid"]
            np.testing.assert_array_equal(data["coords"], asset.coords)
            np.testing.assert_array_equal(data["feats"], asset.feats)
            assert data["coords"].dtype == np.uint8 and data["feats"].dtype == np.float32
            # Two materials in the dataset: they are the two ends of both log scales.
            for material, ends in ((JELLY[0], (-1, -1, 1)), (METAL[0], (1, 1, -1))):
                here = data["material"] == material
                np.testing.assert_allclose(data["properties"][here], [ends] * here.sum())


def test_names_that_pandas_takes_for_numbers_or_nothing_are_found(store, tmp_path):
    import zarr

    for number, names in enumerate(
        [["007", "1e5", "12", "0x1", "9" * 25], ["NA", "nan", "None", "null", "inf"],
         ["0", "1", "2", "3", "10"], ["true", "False", "TRUE", "false", "True"]]
    ):  # fmt: skip
        odd, root = tmp_path / f"{number}.zarr", tmp_path / f"root-{number}"
        shutil.copytree(store, odd)
        group = zarr.open_group(odd, mode="r+", use_consolidated=False)
        group["asset/id"][:] = np.array(names, dtype=object)
        export_store(odd, root, "npz")
        loaded = StructuredLatents(root, ENCODER)
        assert len(loaded.names) == len(names)
        assert all(len(loaded[index][0]) == loaded.loads[index] for index in range(len(names)))
        files = {entry["asset_id"]: entry["file"] for entry in index_of(root)}
        assert sorted(files) == sorted(names)
        assert all((root / file).is_file() for file in files.values())


def test_another_model_takes_the_place_of_the_first(store, tmp_path):
    root = tmp_path / "root"
    export_store(store, root, "npz")
    (root / "notes.txt").write_text("mine")
    export_store(store, root, "npz", assets=["cup"], options=ExportOptions(latent_model="other"))
    files = {path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file()}
    assert files == {"index.json", "metadata.csv", "notes.txt", "latents/other/cup.npz"}
    assert json.loads((root / "index.json").read_text())["files"] == ["metadata.csv"]


@pytest.mark.parametrize("name", ["", "..", "a/b", "../up", "a b", "-x"])
def test_a_model_that_names_no_folder_is_refused(name, store, tmp_path):
    with pytest.raises(ConfigError, match=r"latent_model is .* expected an encoder's name"):
        export_store(store, tmp_path / "root", "npz", options=ExportOptions(latent_model=name))
    assert not (tmp_path / "root").exists()

"""Forms of annotated voxels: each is read as it was written, and what cannot be read is said."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import zarr
from support.raw_sources import field_at

from slatprep.demo.sources import (
    write_description,
    write_physxnet,
    write_points,
    write_vomp,
    write_voxels,
)
from slatprep.errors import ConfigError, InputError
from slatprep.inspect.verify import verify_store
from slatprep.parameters import AlignParameters, BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.dataset import build_store
from slatprep.readers.files import load_source
from slatprep.records import Engine

TABLE = (
    {"name": "density", "unit": "kg/m^3", "scale": "log10"},
    {"name": "damping", "unit": "1", "scale": "linear", "least": 0, "most": 1},
)
CLASSES = ("wood", "steel", "glass")
FORMS = ("npz", "hdf5", "zarr", "ply")


def rows_of(count: int, side: int = 64, seed: int = 0) -> dict[str, np.ndarray]:
    """Return voxels in no order, each once, and columns that tell them apart."""
    rng = np.random.default_rng(seed)
    cells = rng.choice(side**3, count, replace=False)
    voxels = np.stack(np.unravel_index(cells, (side,) * 3), axis=1).astype(np.int32)
    return {
        "voxels": voxels,
        "density": (100.0 + cells % 5000).astype(np.float32),
        "damping": (cells % 97 / 97).astype(np.float32),
        "material": (cells % 3).astype(np.uint8),
        "segment": np.zeros(3, np.float32),  # not asked for
    }


def in_order(rows: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return rows in C order of the grid, as a field has them."""
    order = np.lexsort(rows["voxels"].T[::-1])
    return {name: column[order] for name, column in rows.items() if name != "segment"}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    write_description(tmp_path / "voxels", TABLE, CLASSES)
    return tmp_path / "voxels"


@pytest.mark.parametrize("form", FORMS)
def test_every_form_holds_the_same_72_000_voxels(root, form):
    rows = rows_of(72_000)
    if form == "ply":
        del rows["segment"]
    write_voxels(root, "a", form, rows)
    field = field_at(root)
    expected = in_order(rows)
    np.testing.assert_array_equal(field.voxels, expected["voxels"])
    np.testing.assert_array_equal(field.material, expected["material"])
    for column, name in enumerate(("density", "damping")):
        np.testing.assert_array_equal(field.properties[:, column], expected[name])
    assert field.occupancy.sum() == 72_000
    assert [source.role for source in field.sources] == ["grid", "description"]
    assert field.sources[0].path.startswith("a.")


def test_a_grid_of_128_may_be_fuller_than_all_of_64(root):
    write_description(root, TABLE, CLASSES, resolution=128)
    rows = rows_of(300_000, side=128)
    write_voxels(root, "a", "npz", rows)
    field = field_at(root)
    cells = np.unique(rows["voxels"] // 2, axis=0)
    np.testing.assert_array_equal(field.voxels, cells)


def test_a_structured_array_of_72_000_voxels_is_read(tmp_path):
    rows = rows_of(72_000)
    columns = {
        "youngs_modulus": rows["density"] * np.float32(1000),
        "poissons_ratio": rows["damping"] * np.float32(0.4),
        "density": rows["density"],
    }
    write_vomp(tmp_path / "gvm", "a", rows["voxels"], columns)
    field = field_at(tmp_path / "gvm", "vomp")
    assert not field.classified
    expected = in_order(rows | columns)
    np.testing.assert_array_equal(field.voxels, expected["voxels"])
    for column, name in enumerate(("youngs_modulus", "density", "poissons_ratio")):
        np.testing.assert_array_equal(field.properties[:, column], expected[name])


def test_physxnet_gives_the_density_of_the_voxels_beside_it(tmp_path):
    rows, root = rows_of(500), tmp_path / "physx"
    write_physxnet(root, "a", rows["voxels"], rows["density"])
    field = field_at(root, "physxnet")
    assert [one.name for one in field.table] == ["density"]
    expected = in_order(rows)
    np.testing.assert_array_equal(field.voxels, expected["voxels"])
    np.testing.assert_allclose(field.properties[:, 0], expected["density"], rtol=1e-6)
    np.testing.assert_array_equal(field.frame, np.eye(4))
    # A row less, and the two no longer belong together.
    np.save(root / "property" / "a2.npy", np.ones((499, 14)))
    with pytest.raises(InputError, match=r"has 499 rows; expected 500, a row a vertex of a\.ply"):
        field_at(root, "physxnet")
    # Nor do they without voxels.
    (root / "voxels" / "a.ply").unlink()
    with pytest.raises(InputError, match=r"nothing says where its rows lie, as there is no voxels"):
        field_at(root, "physxnet")
    (root / "finaljson").mkdir()
    with pytest.raises(ConfigError, match="annotations of the parts of meshes, which have no vox"):
        field_at(root, "physxnet")


@pytest.mark.parametrize(
    ("classes", "said"),
    [
        (["wood", "wood"], "there are 2 classes"),
        ([], "there are 0 classes"),
        ([f"c{k}" for k in range(255)], "there are 255 classes"),
        (["background"], "the names of classes are background"),
        (["Wood"], "the names of classes are Wood"),
    ],
)
def test_class_tables_that_no_store_can_have_are_refused(root, classes, said):
    about = json.loads((root / "source.json").read_text()) | {"classes": classes}
    (root / "source.json").write_text(json.dumps(about))
    write_voxels(root, "a", "npz", rows_of(10))
    with pytest.raises(ConfigError, match=said):
        field_at(root)


def test_a_class_that_the_table_does_not_have_is_refused(root):
    for material in (3, -1, 0.5):
        rows = rows_of(10)
        rows["material"] = np.full(10, material, np.float32)
        write_voxels(root, "a", "npz", rows)
        with pytest.raises(InputError, match=r"has classes that are none; expected 10 of 0\.\.2"):
            field_at(root)


def edit(change: Callable[[str], str]) -> Callable[[Path], object]:
    """Return what changes the text of the metadata of an array."""
    return lambda array: (array / "zarr.json").write_text(change((array / "zarr.json").read_text()))


def chunk_of(array: Path, content: bytes) -> None:
    (array / "c" / "0").write_bytes(content)


def written_anew(array: Path, **how: Any) -> None:
    values = rows_of(3000)[array.name]
    shutil.rmtree(array)
    zarr.create_array(array, data=values, **how)


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (shutil.rmtree, "is not in it"),
    "shards": (lambda a: written_anew(a, chunks=(500,), shards=(3000,)), "sharding_indexed"),
    "version 2": (lambda a: written_anew(a, zarr_format=2), "is not in it"),
    "codec": (edit(lambda t: t.replace('"zstd"', '"numcodecs.pickle"')), "numcodecs.pickle"),
    "rows": (edit(lambda t: json.dumps(json.loads(t) | {"shape": [2**40]})), "N <= 2097152"),
    "metadata": (edit(lambda t: t + " " * 2**16), r"zarr\.json has 6\d{4} bytes"),
    "bomb": (
        lambda a: chunk_of(a, numcodecs.Zstd().encode(bytes(2**24))), "it holds 16777216 bytes"
    ),
    "torn": (lambda a: chunk_of(a, b"torn"), "cannot be unpacked|it holds"),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGES)
def test_zarr_that_cannot_be_read_is_said(root, how):
    write_voxels(root, "a", "zarr", rows_of(3000))
    damage, said = DAMAGES[how]
    damage(root / "a.zarr" / "density")
    with pytest.raises(InputError, match=rf"a\.zarr \[density\].*({said})"):
        field_at(root)


@pytest.mark.parametrize("name", ["voxels", "material", "density", "damping"])
def test_a_lost_chunk_of_zarr_is_refused_unless_it_may_be_empty(root, name):
    rows = rows_of(3000) | {"material": np.zeros(3000, np.uint8)}
    write_voxels(root, "a", "zarr", rows)
    assert len(field_at(root).voxels) == 3000
    chunk = next(file for file in (root / "a.zarr" / name / "c").rglob("*") if file.is_file())
    chunk.unlink()
    key = chunk.relative_to(root / "a.zarr").as_posix()
    with pytest.raises(
        InputError, match=rf"a\.zarr \[{name}\]: its chunk {key} is missing.*empty_c"
    ):
        field_at(root)
    if name != "material":
        return
    about = json.loads((root / "source.json").read_text()) | {"empty_chunks": ["material"]}
    (root / "source.json").write_text(json.dumps(about))
    assert np.unique(field_at(root).material).tolist() == [0]


def test_any_file_of_a_zarr_group_decides_what_it_is_and_no_system_does(root, monkeypatch):
    rows = rows_of(100)
    write_voxels(root, "a", "zarr", rows)
    before = field_at(root).sources[0]
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr("zipfile.sys.platform", "win32")
        assert field_at(root).sources[0] == before
    chunk = next((root / "a.zarr" / "damping" / "c").rglob("0"))
    write_voxels(root, "b", "zarr", rows | {"damping": rows["damping"][::-1]})
    shutil.copy(next((root / "b.zarr" / "damping" / "c").rglob("0")), chunk)
    shutil.rmtree(root / "b.zarr")
    assert field_at(root).sources[0].sha256 != before.sha256


@pytest.mark.parametrize("name", ["a.zarr", "a.ZARR"])
def test_a_zarr_group_that_cannot_be_listed_is_its_own_fault_alone(root, name, monkeypatch):
    """A path longer than the system takes cannot be asked for its size, whoever asks."""
    (root / name).mkdir()
    monkeypatch.chdir(root / name)
    for _ in range(21):
        Path("d" * 200).mkdir()
        os.chdir("d" * 200)
    with pytest.raises(InputError, match="cannot be listed"):
        load_source(root / name, root, "grid")


def test_a_ply_that_claims_more_than_it_has_is_refused(root):
    columns = {axis: np.zeros(3, np.float32) for axis in "xyz"}
    rest = {"density": np.ones(3, np.float32), "damping": np.ones(3, np.float32)}
    write_points(root / "a.ply", columns | rest)
    with pytest.raises(InputError, match="has no property 'material'"):
        field_at(root)
    text = (root / "a.ply").read_bytes().replace(b"vertex 3", b"vertex 99999999999")
    (root / "a.ply").write_bytes(text)
    with pytest.raises(InputError, match="announces more rows than it has"):
        field_at(root)


@pytest.mark.usefixtures("files_are_old")
def test_changed_voxels_of_a_zarr_group_are_looked_up_anew(root):
    box = np.argwhere(np.ones((20, 14, 9))) + 22
    rows = {"voxels": box, "density": np.full(len(box), 500.0), "damping": np.full(len(box), 0.5)}
    rows["material"] = np.zeros(len(box), np.uint8)
    rows["material"][box[:, 0] > 30] = 1
    write_description(root, TABLE, CLASSES, aligned=True)
    write_voxels(root, "a", "zarr", rows)
    slat = root.parent / "slat"
    slat.mkdir()
    feats = np.random.default_rng(0).normal(0, 3, (len(box), 8)).astype(np.float32)
    np.savez(slat / "a.npz", coords=box.astype(np.uint8), feats=feats)
    source = PixieverseSource(root, adapter="voxels")
    parameters = BuildParameters(
        source, SlatSource(slat), align=AlignParameters(engine=Engine.KNOWN)
    )
    first = build_store(parameters, root.parent / "s.zarr")
    assert build_store(parameters, root.parent / "s.zarr").build_id == first.build_id
    assert not verify_store(root.parent / "s.zarr", sources=True).findings
    write_voxels(root, "a", "zarr", rows | {"density": np.full(len(box), 600.0)})
    (finding,) = verify_store(root.parent / "s.zarr", sources=True).findings
    assert "bytes" in finding.what
    assert build_store(parameters, root.parent / "s.zarr").build_id != first.build_id

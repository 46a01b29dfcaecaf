"""Voxels and parts of any form are read as they were written, and what cannot be read is said."""

import json
import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numcodecs
import numpy as np
import pytest
import zarr
from support.made_store import edit_json
from support.raw_sources import field_at
from support.trees import records_beside

from slatprep.demo import sources
from slatprep.errors import ConfigError, InputError
from slatprep.geometry.voxels import boundary, voxels_of
from slatprep.inspect.verify import verify_store
from slatprep.parameters import AlignParameters, BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.readers.adapters import find_grids
from slatprep.readers.contents import contents_of
from slatprep.readers.files import load_source
from slatprep.records import Engine
from slatprep.store import open_store

TABLE = (
    {"name": "density", "unit": "kg/m^3", "scale": "log10"},
    {"name": "damping", "unit": "1", "scale": "linear", "least": 0, "most": 1},
)
CLASSES = ("wood", "steel", "glass")
COLUMNS = {
    "voxels": ["density", "damping"],
    "vomp": ["youngs_modulus", "density", "poissons_ratio"],
    "physxnet": ["density"],
}
"""The properties that each adapter finds."""


def rows_of(count: int, side: int = 64) -> dict[str, np.ndarray]:
    """Return voxels in no order, each once, and columns that tell them apart."""
    cells = np.random.default_rng(0).choice(side**3, count, replace=False)
    voxels = np.stack(np.unravel_index(cells, (side,) * 3), axis=1).astype(np.int32)
    return {
        "voxels": voxels,
        "density": (100.0 + cells % 5000).astype(np.float32),
        "damping": (cells % 97 / 97).astype(np.float32),
        "youngs_modulus": (1e5 + 1e3 * (cells % 5000)).astype(np.float32),
        "poissons_ratio": (cells % 89 / 200).astype(np.float32),
        "material": (cells % 3).astype(np.uint8),
        "segment": np.zeros(3, np.float32),  # not asked for
    }


def write_vomp(folder: Path, rows: dict[str, np.ndarray]) -> None:
    """Write a file of VoMP's dataset by hand: rows of corners in [-0.5, 0.5) and SI values."""
    row = "f4,f4,f4,f4,f4,f4,U32"
    corners = (rows["voxels"] * 0.015625 - 0.5 - 1e-6).T  # as rounding may leave them
    materials = [rows[name] for name in ("youngs_modulus", "poissons_ratio", "density")]
    data = np.rec.fromarrays([*corners, *materials, np.full(len(rows["voxels"]), "seat")], row)
    data.dtype.names = ("x", "y", "z", "youngs_modulus", "poissons_ratio", "density", "segment_id")
    folder.mkdir()
    np.savez_compressed(folder / "a_with_materials.npz", voxel_data=np.asarray(data))


def refused(root: Path, said: str, adapter: str = "voxels", **units: str) -> None:
    """Hold that the one field below a root is refused in such words."""
    with pytest.raises(InputError, match=said):
        field_at(root, adapter, **units)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    sources.write_description(tmp_path / "voxels", TABLE, CLASSES)
    return tmp_path / "voxels"


@pytest.mark.parametrize("form", ["npz", "hdf5", "zarr", "ply", *sources.ONE_FRAME])
def test_every_form_holds_the_same_72_000_voxels(root, form):
    rows = rows_of(72_000)
    order = np.lexsort(rows["voxels"].T[::-1])  # of C, as a field has them
    expected = {name: column[order] for name, column in rows.items() if name != "segment"}
    if form == "ply":
        del rows["segment"]  # Its vertices have no column of another length.
    if form == "vomp":
        write_vomp(root / "voxels", rows)
    elif form == "physxnet":
        sources.write_physxnet(root, "a", rows["voxels"], rows["density"])
    else:
        sources.write_voxels(root, "a", form, rows)
    adapter = form if form in sources.ONE_FRAME else "voxels"
    field = field_at(root, adapter)
    np.testing.assert_array_equal(field.voxels, expected["voxels"])
    assert [one.name for one in field.table] == COLUMNS[adapter]
    for one, values in zip(field.table, field.properties.T, strict=True):
        off = 1e-6 if form == "physxnet" else 0  # PhysXNet's toolkit has g/cm^3.
        np.testing.assert_allclose(values, expected[one.name], rtol=off)
    assert field.occupancy.sum() == 72_000
    if adapter == "voxels":
        np.testing.assert_array_equal(field.material, expected["material"])
        assert [source.role for source in field.sources] == ["grid", "description"]
        assert field.sources[0].path.startswith("a.") and field.frame is None
    else:
        assert not field.classified
        np.testing.assert_array_equal(field.frame, np.eye(4))


def test_a_grid_of_128_may_be_fuller_than_all_of_64(root):
    sources.write_description(root, TABLE, CLASSES, resolution=128)
    rows = rows_of(300_000, side=128)
    sources.write_voxels(root, "a", "npz", rows)
    np.testing.assert_array_equal(field_at(root).voxels, np.unique(rows["voxels"] // 2, axis=0))


def test_a_voxel_that_is_given_twice_is_refused_where_the_rows_differ(root):
    rows = rows_of(80)
    again = {name: np.concatenate([column, column[:1]]) for name, column in rows.items()}
    sources.write_voxels(root, "a", "npz", again)
    assert len(field_at(root).voxels) == 80
    for name, other in (("density", 5000.0), ("material", 2 - rows["material"][0] % 2)):
        changed = again | {name: again[name].copy()}
        changed[name][-1] = other
        sources.write_voxels(root, "a", "npz", changed)
        refused(root, r"rows 0 and 80 are of one voxel, and differ")
    rounded = again | {"density": again["density"].copy()}
    rounded["density"][-1] *= 1 + 1e-6
    sources.write_voxels(root, "a", "npz", rounded)
    assert len(field_at(root).voxels) == 80
    # Of points a cell may hold several.
    points = changed | {"voxels": ((changed["voxels"] + 0.5) / 64 - 0.5).astype(np.float32)}
    sources.write_voxels(root, "a", "npz", points)
    assert len(field_at(root).voxels) == 80


def test_a_resolution_that_is_not_the_voxels_own_is_told(root):
    sources.write_description(root, TABLE, CLASSES, resolution=128)
    for side, tells in ((64, 1), (128, 0)):
        sources.write_voxels(root, "a", "npz", rows_of(300, side))
        told = [text for text in field_at(root).warnings if "unusual places" in text]
        assert len(told) == tells
    sources.write_voxels(root, "a", "npz", rows_of(300))
    (told, *_) = field_at(root).warnings
    assert "as on a grid of 64^3, and 128^3 is read" in told and "source.json" in told


def test_voxels_of_vomp_on_every_second_cell_or_not_finite_are_told(tmp_path):
    rows = rows_of(500, 32)
    write_vomp(tmp_path / "coarse", rows | {"voxels": 2 * rows["voxels"]})
    (told,) = field_at(tmp_path / "coarse", "vomp").warnings
    assert "all coordinates are even, or all are odd, as on a grid of 32^3" in told
    # Its toolkit fills parts one by one, so that a cell where two touch occurs twice.
    twice = {name: np.concatenate([column, column[:1]]) for name, column in rows.items()}
    twice["density"][-1] = 9000.0
    write_vomp(tmp_path / "twice", twice)
    told = field_at(tmp_path / "twice", "vomp").warnings
    assert "501 voxels were merged into 500 of 64^3" in told
    data = np.load(tmp_path / "coarse" / "a_with_materials.npz")["voxel_data"]
    data["y"][3] = np.nan
    np.savez(tmp_path / "coarse" / "a_with_materials.npz", voxel_data=data)
    refused(tmp_path / "coarse", r"position \[.*nan.*\] in row 3 is not finite", "vomp")


def test_poissons_ratio_of_any_source_has_the_bounds_of_a_material_unless_others_are_stated(root):
    ratio = {"name": "poissons_ratio", "unit": "1", "scale": "linear"}
    rows = rows_of(300)
    rows["poissons_ratio"] = np.where(np.arange(300) < 100, 0.9, 0.3).astype(np.float32)
    sources.write_voxels(root, "a", "npz", rows)
    for stated in ({}, {"least": -1}):
        sources.write_description(root, (*TABLE, ratio | stated), CLASSES)
        refused(root, "100 of 300 annotated voxels are unphysical")
    sources.write_description(root, (*TABLE, ratio | {"least": -1, "most": 1}), CLASSES)
    assert field_at(root).unphysical == 0


def test_a_known_property_in_another_unit_is_refused(root):
    modulus = {"name": "youngs_modulus", "unit": "GPa", "scale": "log10"}
    sources.write_description(root, (*TABLE, modulus), CLASSES)
    source = PixieverseSource(root, adapter="voxels")
    mine = PixieverseSource(root, samples="merge")
    for first, also, table in (
        (source, (), r"\[pixieverse\]"),
        (mine, (source,), r"\[\[also\]\] 1"),
    ):
        said = f"has youngs_modulus in GPa; expected Pa.* by units in {table}$"
        with pytest.raises(ConfigError, match=said):
            contents_of(BuildParameters(first, SlatSource(root), also=also))


def test_rows_and_voxels_of_physxnet_belong_together(tmp_path):
    rows, root = rows_of(500), tmp_path / "physx"
    sources.write_physxnet(root, "a", rows["voxels"], rows["density"])
    as_stated = field_at(root, "physxnet", density="kg/m^3").properties[:, 0]
    np.testing.assert_allclose(np.sort(as_stated), np.sort(rows["density"]) / 1000, rtol=1e-6)
    np.save(root / "property" / "a2.npy", np.ones((499, 14)))
    refused(root, r"has 499 rows; expected 500, a row a vertex of a\.ply", "physxnet")
    (root / "voxels" / "a.ply").unlink()
    refused(root, r"nothing says where its rows lie, as there is no voxels", "physxnet")
    (root / "finaljson").mkdir()
    with pytest.raises(ConfigError, match="annotations of the parts of meshes, which have no vox"):
        field_at(root, "physxnet")


@pytest.mark.parametrize(("classes", "said"), [
    (["wood", "wood"], "there are 2 classes"),
    ([], "there are 0 classes"),
    ([f"c{k}" for k in range(255)], "there are 255 classes"),
    (["background"], "the names of classes are background"),
    (["Wood"], "the names of classes are Wood"),
    (["wood"], "the key 'aligned' occurs twice"),
])  # fmt: skip
def test_descriptions_that_no_store_can_follow_are_refused(root, classes, said):
    edit_json(root / "source.json", lambda about: about.update(classes=classes))
    if "twice" in said:
        twice = '{"aligned": true, "aligned": false, '
        (root / "source.json").write_text((root / "source.json").read_text().replace("{", twice, 1))
    sources.write_voxels(root, "a", "npz", rows_of(10))
    with pytest.raises(ConfigError, match=said):
        field_at(root)


def test_a_class_that_the_table_does_not_have_is_refused(root):
    for material in (3, -2, 0.5):
        rows = rows_of(10)
        rows["material"] = np.full(10, material, np.float32)
        sources.write_voxels(root, "a", "npz", rows)
        refused(
            root, rf"has class {material:g} in row 0; expected classes 0 to 2, or -1 for an occ"
        )


def test_a_voxel_without_a_class_is_occupied_and_no_more(root):
    rows = rows_of(100)
    rows["material"] = np.where(np.arange(100) < 60, -1, 1)
    rows["density"] = np.where(np.arange(100) < 60, np.nan, 1000.0)
    sources.write_voxels(root, "a", "npz", rows)
    field = field_at(root)
    assert field.occupancy[tuple(rows["voxels"].T)].all() and field.occupancy.sum() == 100
    assert len(field.voxels) == 40 and field.unphysical == 0 and (field.material == 1).all()
    assert field.warnings == ("60 occupied voxels have no class (-1); not annotated",)
    rows["density"][60:65] = 0
    sources.write_voxels(root, "a", "npz", rows)
    refused(root, "5 of 40 annotated voxels are unphysical, the first by density 0 in row 60")
    rows["material"] = np.full(100, -1)
    sources.write_voxels(root, "a", "npz", rows)
    refused(root, "has no class in any of 100 rows; expected a voxel with a class")


def edit(change: Callable[[str], str]) -> Callable[[Path], object]:
    """Return what changes the text of the metadata of an array."""
    return lambda array: (array / "zarr.json").write_text(change((array / "zarr.json").read_text()))


def written_anew(array: Path, **how: Any) -> None:
    shutil.rmtree(array)
    zarr.create_array(array, data=rows_of(3000)[array.name], **how)


def in_shards(array: Path) -> None:
    wide = rows_of(3000)[array.name].ndim - 1  # The last chunk and the last shard reach beyond.
    written_anew(array, chunks=(700, *[2] * wide), shards=(2100, *[4] * wide))


def test_arrays_in_shards_are_read_as_others_are(root):
    sources.write_voxels(root, "a", "zarr", rows_of(3000))
    plain = field_at(root)
    for name in ("voxels", "density", "material"):
        in_shards(root / "a.zarr" / name)
    assert sorted(one.name for one in (root / "a.zarr" / "density" / "c").iterdir()) == ["0", "1"]
    sharded = field_at(root)
    assert sharded.sources != plain.sources
    for name in ("voxels", "properties", "material"):
        np.testing.assert_array_equal(getattr(sharded, name), getattr(plain, name))


DAMAGES: dict[str, tuple[Callable[[Path], object], str]] = {
    "missing": (shutil.rmtree, "is not in it"),
    "torn shard": (lambda a: (in_shards(a), os.truncate(a / "c/0", 500)), "no sound index"),
    "changed shard": (lambda a: (in_shards(a), (a / "c/0").open("r+b").write(b"torn")),
                      "cannot be unpacked|it holds"),
    "half a shard": (
        lambda a: zarr.create_array(a, shape=(3000,), dtype="f4", chunks=(100,), shards=(3000,),
                                    overwrite=True).__setitem__(slice(1500), 900.0),
        r"its chunk density/c/0 from \[1500\] is missing; expected all chunks"),
    "big end": (lambda a: written_anew(a, serializer=zarr.codecs.BytesCodec(endian="big")),
                "is big-endian"),
    "version 2": (lambda a: written_anew(a, zarr_format=2), "is not in it"),
    "codec": (edit(lambda t: t.replace('"zstd"', '"numcodecs.pickle"')), "numcodecs.pickle"),
    "rows": (edit(lambda t: json.dumps(json.loads(t) | {"shape": [2**40]})), "N <= 2097152"),
    "metadata": (edit(lambda t: t + " " * 2**16), r"zarr\.json has 6\d{4} bytes"),
    "bomb": (lambda a: (a / "c/0").write_bytes(numcodecs.Zstd().encode(bytes(2**24))),
             "it holds 16777216 bytes"),
    "torn": (lambda a: (a / "c/0").write_bytes(b"torn"), "cannot be unpacked|it holds"),
}  # fmt: skip


@pytest.mark.parametrize("how", DAMAGES)
def test_zarr_that_cannot_be_read_is_said(root, how):
    sources.write_voxels(root, "a", "zarr", rows_of(3000))
    damage, said = DAMAGES[how]
    damage(root / "a.zarr" / "density")
    refused(root, rf"a\.zarr \[density\].*({said})")


@pytest.mark.parametrize("form", ["hdf5", "zarr"])
@pytest.mark.parametrize(("attribute", "value", "said"), [
    ("scale_factor", 0.5, "its values are packed, by scale_factor 0.5"),
    ("add_offset", 100, "its values are packed, by add_offset 100"),
    ("_FillValue", 2500.0, "_FillValue 2500.0 marks values as missing"),
    ("missing_value", 2500, "missing_value 2500 marks values as missing"),
    ("units", "g/cm^3", "its attribute units says 'g/cm^3'; expected values in kg/m^3"),
    ("units", "kg m-2", "its attribute units says 'kg m-2'"),
    ("units", "10^3 kg/m^3", "its attribute units says '10^3 kg/m^3'"),
    ("units", "1000 kg/m3", "its attribute units says '1000 kg/m3'"),
    ("units", "%", "its attribute units says '%'"),
    ("_FillValue", "AAAAAACIo0A=", "_FillValue 2500.0 marks values as missing"),
    ("_FillValue", "no base64", ""),
    ("units", "kg-m", "its attribute units says 'kg-m'"),
    ("units", np.array([b"kg/m^3"]), ""),
    ("units", "kg m-3", ""),
    ("units", "kg·m⁻³", ""),
    ("units", "kg / m**3", ""),
    ("units", "", ""),
    ("scale_factor", 1.0, ""),
    ("_FillValue", -1.0, ""),
    ("long_name", "mass over volume", ""),
])  # fmt: skip
def test_attributes_that_give_values_another_meaning_are_heeded(root, form, attribute, value, said):
    rows = rows_of(100)
    rows["density"][7] = 2500.0
    sources.write_voxels(root, "a", form, rows)
    if form == "hdf5":
        with h5py.File(root / "a.h5", "a") as file:
            file["density"].attrs[attribute] = value
    else:
        given = value.astype(str).tolist() if isinstance(value, np.ndarray) else value
        zarr.open_array(root / "a.zarr" / "density").attrs[attribute] = given
    if said:
        refused(root, rf"\[density\]: {re.escape(said)}")
    else:
        assert (field_at(root).properties[:, 0] == 2500.0).sum() == 1


@pytest.mark.parametrize(("column", "said"), [
    (lambda column: column.astype(h5py.enum_dtype({"steel": 0, "wood": 1})), "is an enumeration"),
    (lambda column: column.astype("O").astype(str).astype(object), "is text, or has rows of"),
])  # fmt: skip
def test_classes_by_names_in_hdf5_are_refused(root, column, said):
    rows = rows_of(100)
    rows["material"] %= 2
    sources.write_voxels(root, "a", "hdf5", rows)
    with h5py.File(root / "a.h5", "a") as file:
        del file["material"]
        file["material"] = column(rows["material"])
    refused(root, rf"a\.h5 \[material\]: {said}")


def test_hdf5_that_is_cut_off_or_damaged_is_told_as_that(root):
    rows = rows_of(3000)
    sources.write_voxels(root, "a", "hdf5", rows)
    with h5py.File(root / "a.h5", "a") as file:
        del file["density"]
        file.create_dataset("density", data=rows["density"], chunks=(500,), compression="gzip")
        at = file["density"].id.get_chunk_info(2).byte_offset
    whole = (root / "a.h5").read_bytes()
    (root / "a.h5").write_bytes(whole[:at] + bytes(8) + whole[at + 8 :])
    refused(root, r"a\.h5 \[density\]: the chunk at \(1000,\) is damaged")
    (root / "a.h5").write_bytes(whole[: len(whole) // 2])
    refused(root, r"a\.h5: is no readable HDF5 file: it begins as one, and may be cut off")


def test_two_forms_of_one_object_are_refused(root):
    for form in ("npz", "hdf5"):
        sources.write_voxels(root, "a", form, rows_of(100))
    source = PixieverseSource(root=root, adapter="voxels")
    assert {one.path for one in find_grids(source)["a"]} == {"a.npz", "a.h5"}
    refused(root, r"2 grids for one id 'a' \(a\.h5, a\.npz\)")
    # Patterns that a person states are in the order of preference.
    stated = PixieverseSource(root=root, adapter="voxels", grid=("{id}.npz", "{id}.*"))
    assert [one.path for one in find_grids(stated)["a"]] == ["a.npz"]


def test_a_unit_of_the_dataset_definition_goes_before_that_of_the_description(root):
    sources.write_voxels(root, "a", "hdf5", rows_of(100))
    with h5py.File(root / "a.h5", "a") as file:
        file["density"].attrs["units"] = "kg/m^3"
    assert len(field_at(root).voxels) == 100
    refused(root, "says 'kg/m\\^3'; expected values in g/cm\\^3", density="g/cm^3")


@pytest.mark.parametrize("name", ["voxels", "material", "density", "damping"])
def test_a_lost_chunk_of_zarr_is_refused_unless_it_may_be_empty(root, name):
    rows = rows_of(3000) | {"material": np.zeros(3000, np.uint8)}
    sources.write_voxels(root, "a", "zarr", rows)
    assert len(field_at(root).voxels) == 3000
    chunk = next(file for file in (root / "a.zarr" / name / "c").rglob("*") if file.is_file())
    chunk.unlink()
    key = chunk.relative_to(root / "a.zarr").as_posix()
    refused(root, rf"a\.zarr \[{name}\]: its chunk {key} is missing.*empty_c")
    if name == "material":
        edit_json(root / "source.json", lambda about: about.update(empty_chunks=["material"]))
        assert np.unique(field_at(root).material).tolist() == [0]


def test_any_file_of_a_zarr_group_decides_what_it_is_and_no_system_does(root, monkeypatch):
    rows = rows_of(100)
    sources.write_voxels(root, "a", "zarr", rows)
    before = field_at(root).sources[0]
    with monkeypatch.context() as elsewhere:
        elsewhere.setattr("zipfile.sys.platform", "win32")
        assert field_at(root).sources[0] == before
    chunk = next((root / "a.zarr" / "damping" / "c").rglob("0"))
    sources.write_voxels(root, "b", "zarr", rows | {"damping": rows["damping"][::-1]})
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


def test_a_ply_without_a_column_of_the_table_is_refused(root):
    columns = {axis: np.zeros(3, np.float32) for axis in "xyz"}
    rest = {"density": np.ones(3, np.float32), "damping": np.ones(3, np.float32)}
    sources.write_points(root / "a.ply", columns | rest)
    refused(root, "has no property 'material'")


HANDLE = {"density": "7.8 g/cm^3", "Young's Modulus (GPa)": "200", "Poisson's Ratio": "0.29"}
HEAD = {"density": "1.1 g/cm^3", "Young's Modulus (GPa)": 0.01, "Poisson's Ratio": 0.45}


def write_object(folder: Path, parts: list[tuple[dict[str, Any], Any]], nested: bool = False):
    """Write parts as PhysX-Anything does, with more keys than are read; return their root."""
    root, rows = folder / "p", []
    for label, (stuff, mesh) in enumerate(parts):
        rows.append({"label": label, "name": "any", "priority_rank": 1, "material": "any"} | stuff)
        place = root / "partseg" / "a" / "objs" / (str(label) if nested else "")
        place.mkdir(parents=True, exist_ok=True)
        mesh.export(place / f"{label}.obj")
    about = {"object_name": "thing", "dimension": "10*10*10", "parts": rows, "group_info": {}}
    (root / "finaljson").mkdir()
    (root / "finaljson" / "a.json").write_text(json.dumps(about))
    return root


def cuboid(*corners: tuple[float, float, float]) -> Any:
    """Return the mesh of a box by two opposite corners."""
    return pytest.importorskip("trimesh").creation.box(bounds=corners)


def test_parts_are_filled_and_have_their_own_materials(tmp_path):
    # A hammer along x, of any scale and place: head for x in 24..32, handle for 0..24, of 32.
    handle, head = cuboid((100, 0, 0), (124, 4, 4)), cuboid((124, -6, -2), (132, 10, 6))
    field = field_at(write_object(tmp_path, [(HANDLE, handle), (HEAD, head)]), "parts")
    x = field.voxels[:, 0].astype(int)
    assert x.min() == 0 and x.max() == 63
    for part, stuff in ((x > 48, [1e7, 1100, 0.45]), (x < 47, [2e11, 7800, 0.29])):
        np.testing.assert_allclose(field.properties[part], [stuff] * part.sum())
    # The volume of a solid, within the half voxel that a surface is thick.
    expected = (24 * 4 * 4 + 8 * 16 * 8) * 8
    assert expected < len(field.voxels) < 1.45 * expected
    assert field.table[0].name == "youngs_modulus" and not field.classified


def test_what_lies_inside_another_part_keeps_its_own(tmp_path):
    inside, outside = cuboid((-4, -4, -4), (4, 4, 4)), cuboid((-16, -16, -16), (16, 16, 16))
    field = field_at(write_object(tmp_path, [(HANDLE, inside), (HEAD, outside)]), "parts")
    assert len(field.voxels) == 64**3
    centre = np.abs(field.voxels.astype(int) - 31.5).max(axis=1) < 8
    assert (field.properties[centre, 1] == 7800).all()
    assert (field.properties[~centre, 1] == 1100).mean() > 0.98


ROD = (0, 0, 0), (64, 1, 1)
"""Of few voxels, where values are looked at: filling a cube takes ten times as long."""


def test_units_may_be_stated_in_the_definition(tmp_path):
    stuff = {"density": 7800, "Young's Modulus (GPa)": 200_000, "Poisson's Ratio": 0.29}
    root = write_object(tmp_path, [(stuff, cuboid(*ROD))])
    field = field_at(root, "parts", youngs_modulus="MPa", density="kg/m^3")
    np.testing.assert_allclose(field.properties[0], [2e11, 7800, 0.29])
    stuff |= {"density": "7800 kg/m^3", "Young's Modulus (GPa)": "200 GPa"}
    nested = write_object(tmp_path / "texts", [(stuff, cuboid(*ROD))], nested=True)
    field = field_at(nested, "parts")
    np.testing.assert_allclose(field.properties[0], [2e11, 7800, 0.29])
    # A unit behind a number is another statement.
    root = write_object(tmp_path / "both", [(HANDLE, cuboid(*ROD))])
    refused(root, r"has density '7.8 g/cm.3'; expected a bare number", "parts", density="kg/m^3")


ADVISED = re.compile(r"or (say|leave) units = \{ (.+?) \}")


def followed(root: Path, adapter: str, units: dict[str, str], expected: list[float]) -> None:
    """Hold that a field is as expected once the advice on units was followed to the letter.

    Wrong units of plausible values are advised nothing.
    """
    try:
        field_at(root, adapter, **units)
    except InputError as error:
        verb, keys = ADVISED.search(str(error)).groups()
        said = dict(re.findall(r'(\w+) = "(.+?)"', keys))
        field = field_at(root, adapter, **(said if verb == "say" else {}))
        right = np.allclose(field.properties[0], expected, rtol=1e-5)
        assert right or "check which guess is right" in str(error)


@pytest.mark.parametrize("stated", [
    {}, {"density": "kg/m^3"}, {"density": "g/cm^3"}, {"density": "log10 kg/m^3"},
    {"youngs_modulus": "Pa"}, {"youngs_modulus": "MPa"}, {"youngs_modulus": "log10 Pa"},
    {"youngs_modulus": "GPa", "density": "g/cm^3"}, {"youngs_modulus": "Pa", "density": "kg/m^3"},
])  # fmt: skip
@pytest.mark.parametrize(("modulus", "density"), [
    (200, 7.8), (2e5, 7.8), (2e11, 7800), (200, 7800), (2e11, 7.8), (200, "7.8 g/cm^3"),
    (2e11, "7800 kg/m³"), ("200 GPa", 7800),
])  # fmt: skip
def test_advice_on_units_holds_to_the_letter(tmp_path, modulus, density, stated):
    stuff = {"density": density, "Young's Modulus (GPa)": modulus, "Poisson's Ratio": 0.29}
    said = {name for name, one in (("density", density), ("youngs_modulus", modulus))
            if isinstance(one, str)}  # fmt: skip
    root = write_object(tmp_path, [(stuff, cuboid(*ROD))])
    units = {name: unit for name, unit in stated.items() if name not in said}
    followed(root, "parts", units, [2e11, 7800, 0.29])
    if isinstance(density, float | int) and "youngs_modulus" not in stated:
        place, rows = tmp_path / "physx", rows_of(200)
        sources.write_physxnet(place, "a", rows["voxels"], np.full(200, 1e3 * density))
        followed(place, "physxnet", stated, [7800])


def test_the_lightest_and_softest_values_are_those_of_the_bounds(tmp_path):
    for k, (modulus, density) in enumerate([(0.005, 0.01), (0.01, 7.8)]):
        stuff = {"density": density, "Young's Modulus (GPa)": modulus, "Poisson's Ratio": 0.29}
        field = field_at(write_object(tmp_path / f"{k}", [(stuff, cuboid(*ROD))]), "parts")
        assert field.properties[0, :2].tolist() == [modulus * 1e9, density * 1e3]
    rows = rows_of(200)
    sources.write_physxnet(tmp_path, "a", rows["voxels"], np.full(200, 10.0))
    assert field_at(tmp_path, "physxnet").properties[0].tolist() == [10.0]


def test_parts_and_meshes_belong_together_one_by_one(tmp_path):
    root = write_object(tmp_path, [(HANDLE, cuboid(*ROD)), (HEAD, cuboid((64, 0, 0), (128, 1, 1)))])
    about = root / "finaljson" / "a.json"
    document = json.loads(about.read_text())
    for labels in ([1, 1], [0, True]):
        for part, label in zip(document["parts"], labels, strict=True):
            part["label"] = label
        about.write_text(json.dumps(document))
        refused(root, "are not integers, each of one part", "parts")
    document["parts"] = document["parts"][:1]
    document["parts"][0]["label"] = 0
    about.write_text(json.dumps(document))
    (told,) = field_at(root, "parts").warnings
    assert told == "unusual places: a.json has no part of the meshes 1, which are left out"


@pytest.mark.parametrize(("key", "value", "said"), [
    ("density", "heavy", r"part 0 has density 'heavy'; expected a number or g/cm"),
    ("density", "1 lb/ft^3", r"part 0 has density '1 lb/ft"),
    ("Poisson's Ratio", None, r"part 0 has Poisson's Ratio None; expected a number"),
    ("label", "x", r"is no annotation of parts"),
    ("mesh", "v 0 0 0\n", r"is no mesh"),
    ("mesh", None, r"part 0 has no mesh"),
    # Values that no units explain, and a unit that is the file's own.
    ("Poisson's Ratio", 0.6, "poissons_ratio 0.6 in row 0"),
    ("density", 0, "density 0 in row"),
    ("density", "7800 g/cm^3", "a material has, in GPa and the file's own unit; or set pl"),
])  # fmt: skip
def test_parts_that_are_none_or_of_no_material_are_named(key, value, said, tmp_path):
    root = write_object(tmp_path, [({**HEAD, key: value}, cuboid(*ROD))])
    if key == "mesh":
        mesh = root / "partseg" / "a" / "objs" / "0.obj"
        mesh.unlink() if value is None else mesh.write_text(value)
    refused(root, said, "parts")


def test_an_object_whose_meshes_cannot_be_found_stops_no_other(tmp_path):
    root = write_object(tmp_path, [(HEAD, cuboid(*ROD))])
    objects = root / "partseg"
    for name in "bc":
        shutil.copy(root / "finaljson" / "a.json", root / "finaljson" / f"{name}.json")
        (objects / name).mkdir()
    (objects / "b" / "objs").symlink_to("objs")  # a link to itself
    (objects / "c" / "objs").mkdir()
    for part in range(251):
        (objects / "c" / "objs" / f"{part}.obj").touch()
    found = find_grids(PixieverseSource(root, adapter="parts"))
    problems = {name: one.problem for name, (one,) in found.items()}
    assert problems.keys() == set("abc") and problems["a"] == ""
    assert "partseg/b/objs/: cannot be listed (" in problems["b"]
    assert problems["c"] == "finaljson/c.json has 251 meshes; expected at most 250"


def known_build(root: Path, adapter: str, coords: np.ndarray) -> tuple[BuildParameters, Path]:
    """Give the one object below a root a SLAT in its own frame; return how to build, and where."""
    feats = np.random.default_rng(0).normal(0, 3, (len(coords), 8)).astype(np.float32)
    slat = root.parent / "slat"
    slat.mkdir(exist_ok=True)
    np.savez(slat / "a.npz", coords=coords, feats=feats)
    source, known = PixieverseSource(root, adapter=adapter), AlignParameters(engine=Engine.KNOWN)
    return BuildParameters(source, SlatSource(slat), align=known), root.parent / "s.zarr"


@pytest.mark.usefixtures("files_are_old")
def test_changed_voxels_of_a_zarr_group_are_looked_up_anew(root):
    box = np.argwhere(np.ones((20, 14, 9))) + 22
    rows = {"voxels": box, "density": np.full(len(box), 500.0), "damping": np.full(len(box), 0.5)}
    rows["material"] = (box[:, 0] > 30).astype(np.uint8)
    sources.write_description(root, TABLE, CLASSES, aligned=True)
    sources.write_voxels(root, "a", "zarr", rows)
    of = _, store = known_build(root, "voxels", box.astype(np.uint8))
    first = build_store(*of)
    assert build_store(*of).build_id == first.build_id
    assert not verify_store(store, sources=True).findings
    sources.write_voxels(root, "a", "zarr", rows | {"density": np.full(len(box), 600.0)})
    (finding,) = verify_store(store, sources=True).findings
    assert "bytes" in finding.what
    assert build_store(*of).build_id != first.build_id


@pytest.mark.usefixtures("files_are_old")
def test_a_store_of_parts_follows_every_mesh(tmp_path):
    """A hammer with a hook, of which one part after the other becomes smaller."""
    parts = [
        (HANDLE, cuboid((0, 0, 0), (24, 4, 4))),
        (HEAD, cuboid((20, -6, -2), (32, 10, 6))),
        (HANDLE, cuboid((2, 1, 0), (5, 3, 12))),
    ]
    root = write_object(tmp_path, parts)
    field = field_at(root, "parts")
    of = _, store = known_build(root, "parts", voxels_of(boundary(field.occupancy)))

    def heavy() -> np.ndarray:
        """Say which voxels of the asset are of the handle's material."""
        return open_store(store).asset("a").properties_si[:, 1] > 5000

    assert build_store(*of).verdicts == {"good": 1}
    assert 0.05 < heavy().mean() < 0.9
    names = {file["path"] for file in records_beside(store)["a"]["sources"]}
    assert {f"partseg/a/objs/{k}.obj" for k in range(3)} <= names
    for part, half in ((2, ((2, 1, 0), (5, 3, 7))), (0, ((0, 0, 0), (12, 4, 4)))):
        assert plan_build(*of).assets[0].reason == "unchanged"
        cuboid(*half).export(root / "partseg" / "a" / "objs" / f"{part}.obj")
        assert plan_build(*of).assets[0].reason == "sources changed: description"
        before = heavy()
        build_store(*of)
        assert heavy().sum() < 0.95 * before.sum()

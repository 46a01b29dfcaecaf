"""Objects of parts, in the form that PhysX-Anything's code reads, become fields of voxels."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.raw_sources import field_at

from slatprep.errors import InputError
from slatprep.parameters import AlignParameters, BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.dataset import build_store, plan_build
from slatprep.records import Engine
from slatprep.store import open_store

trimesh = pytest.importorskip("trimesh")

HANDLE = {"density": "7.8 g/cm^3", "Young's Modulus (GPa)": "200", "Poisson's Ratio": "0.29"}
HEAD = {"density": "1.1 g/cm^3", "Young's Modulus (GPa)": 0.01, "Poisson's Ratio": 0.45}


def write_object(
    root: Path, name: str, parts: list[tuple[dict[str, Any], Any]], nested: bool = False
) -> None:
    """Write parts as PhysX-Anything writes and reads them; its JSON has more keys than are read."""
    rows = [
        {"label": label, "name": f"part {label}", "priority_rank": 1, "material": "stuff", **stuff}
        for label, (stuff, _) in enumerate(parts)
    ]
    about = {"object_name": "thing", "dimension": "10*10*10", "parts": rows, "group_info": {}}
    (root / "finaljson").mkdir(parents=True, exist_ok=True)
    (root / "finaljson" / f"{name}.json").write_text(json.dumps(about))
    for label, (_, mesh) in enumerate(parts):
        folder = root / "partseg" / name / "objs" / (str(label) if nested else "")
        folder.mkdir(parents=True, exist_ok=True)
        mesh.export(folder / f"{label}.obj")


def box(low: tuple[float, ...], high: tuple[float, ...]) -> Any:
    low_, high_ = np.array(low), np.array(high)
    made = trimesh.creation.box(extents=high_ - low_)
    made.apply_translation((low_ + high_) / 2)
    return made


@pytest.mark.parametrize("nested", [False, True])
def test_parts_are_filled_and_have_their_own_materials(nested, tmp_path):
    # A hammer along x, of any scale and place: head for x in 24..32, handle for 0..24, of 32.
    handle, head = box((100, 0, 0), (124, 4, 4)), box((124, -6, -2), (132, 10, 6))
    write_object(tmp_path / "p", "a", [(HANDLE, handle), (HEAD, head)], nested)
    field = field_at(tmp_path / "p", "parts")
    x = field.voxels[:, 0].astype(int)
    assert x.min() == 0 and x.max() == 63
    is_head = x > 48
    np.testing.assert_allclose(field.properties[is_head], [[1e7, 1100, 0.45]] * is_head.sum())
    inner = x < 47
    np.testing.assert_allclose(field.properties[inner], [[2e11, 7800, 0.29]] * inner.sum())
    # The volume of a solid, within the half voxel that a surface is thick.
    expected = (24 * 4 * 4 + 8 * 16 * 8) * 8
    assert expected < len(field.voxels) < 1.45 * expected
    assert field.table[0].name == "youngs_modulus" and not field.classified


def test_what_lies_inside_another_part_keeps_its_own(tmp_path):
    inside, outside = box((-4, -4, -4), (4, 4, 4)), box((-16, -16, -16), (16, 16, 16))
    write_object(tmp_path / "p", "a", [(HANDLE, inside), (HEAD, outside)])
    field = field_at(tmp_path / "p", "parts")
    assert len(field.voxels) == 64**3
    centre = np.abs(field.voxels.astype(int) - 31.5).max(axis=1) < 8
    assert (field.properties[centre, 1] == 7800).all()
    assert (field.properties[~centre, 1] == 1100).mean() > 0.98


def test_units_may_be_stated_in_the_definition(tmp_path):
    stuff = {"density": 7800, "Young's Modulus (GPa)": 200_000, "Poisson's Ratio": 0.29}
    write_object(tmp_path / "p", "a", [(stuff, box((0, 0, 0), (1, 1, 1)))])
    field = field_at(tmp_path / "p", "parts", youngs_modulus="MPa", density="kg/m^3")
    np.testing.assert_allclose(field.properties[0], [2e11, 7800, 0.29])


@pytest.mark.parametrize(
    ("stuff", "said"),
    [
        ({**HEAD, "density": "heavy"}, "part 0 has density 'heavy'; expected a number or g/cm"),
        ({**HEAD, "density": "1 lb/ft^3"}, "part 0 has density '1 lb/ft"),
        ({**HEAD, "Poisson's Ratio": None}, "part 0 has Poisson's Ratio None; expected a number"),
    ],
)
def test_what_is_no_number_is_named(stuff, said, tmp_path):
    write_object(tmp_path / "p", "a", [(stuff, box((0, 0, 0), (1, 1, 1)))])
    with pytest.raises(InputError) as refused:
        field_at(tmp_path / "p", "parts")
    assert said in str(refused.value)


def test_missing_and_broken_meshes_are_named(tmp_path):
    write_object(tmp_path / "p", "a", [(HEAD, box((0, 0, 0), (1, 1, 1)))])
    mesh = tmp_path / "p" / "partseg" / "a" / "objs" / "0.obj"
    mesh.write_text("v 0 0 0\n")
    with pytest.raises(InputError, match="is no mesh"):
        field_at(tmp_path / "p", "parts")
    mesh.unlink()
    with pytest.raises(InputError, match="part 0 has no mesh"):
        field_at(tmp_path / "p", "parts")
    (tmp_path / "p" / "finaljson" / "a.json").write_text('{"parts": [{"label": "x"}]}')
    with pytest.raises(InputError, match="is no annotation of parts"):
        field_at(tmp_path / "p", "parts")


@pytest.mark.usefixtures("files_are_old")
def test_a_store_of_parts_follows_every_mesh(tmp_path):
    """A hammer with a hook, of which one part after the other becomes smaller."""
    parts = [
        (HANDLE, box((0, 0, 0), (24, 4, 4))),
        (HEAD, box((20, -6, -2), (32, 10, 6))),
        (HANDLE, box((2, 1, 0), (5, 3, 12))),
    ]
    write_object(tmp_path / "p", "a", parts)
    field = field_at(tmp_path / "p", "parts")
    solid = np.zeros((66,) * 3, bool)
    solid[tuple(field.voxels.T.astype(int) + 1)] = True
    buried = np.all([np.roll(solid, s, a) for s in (-1, 1) for a in range(3)], axis=0)
    shell = (np.argwhere(solid & ~buried) - 1).astype(np.uint8)
    feats = np.random.default_rng(0).normal(size=(len(shell), 8)).astype(np.float32)
    np.savez(tmp_path / "slat" / "a.npz", coords=shell, feats=feats)
    source = PixieverseSource(tmp_path / "p", adapter="parts")
    store = tmp_path / "s.zarr"
    known = AlignParameters(engine=Engine.KNOWN)
    of = BuildParameters(source, SlatSource(tmp_path / "slat"), align=known), store

    def heavy() -> np.ndarray:
        """Say which voxels of the asset are of the handle's material."""
        return open_store(store).asset("a").properties_si[:, 1] > 5000

    assert build_store(*of).verdicts == {"good": 1}
    assert 0.05 < heavy().mean() < 0.9
    record = json.loads((tmp_path / "s.manifests" / "assets.jsonl").read_text().splitlines()[0])
    names = {file["path"] for file in record["sources"]}
    assert {f"partseg/a/objs/{k}.obj" for k in range(3)} <= names
    for part, half in ((2, ((2, 1, 0), (5, 3, 7))), (0, ((0, 0, 0), (12, 4, 4)))):
        assert plan_build(*of).assets[0].reason == "unchanged"
        box(*half).export(tmp_path / "p" / "partseg" / "a" / "objs" / f"{part}.obj")
        assert plan_build(*of).assets[0].reason == "sources changed: description"
        before = heavy()
        build_store(*of)
        assert heavy().sum() < 0.95 * before.sum()

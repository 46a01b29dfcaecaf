"""Demo data of every source and encoder: two commands build it, and a third holds it to truth."""

import json
import re
import shlex
from typing import get_args

import numpy as np
import pytest
from support import commands

from slatprep import open_store
from slatprep.demo import make_demo
from slatprep.demo.latents import GRIDS, Encoder
from slatprep.demo.sources import CLASSES, ONE_FRAME, TABLE, Source, columns_of

NAMES = [str(one["name"]) for one in TABLE]
HELD = {
    "physxnet": ["density"],
    **dict.fromkeys(("voxels-npz", "voxels-hdf5", "voxels-zarr", "voxels-ply"), NAMES),
}


def run_printed(output: str, word: str, *more: str) -> str:
    """Run the command that a line of an output tells; return what it prints."""
    (line,) = (line for line in output.splitlines() if line.startswith(word))
    return commands.run(*shlex.split(line.partition(" slatprep ")[2]), *more).output


@pytest.mark.parametrize("source", get_args(Source))
def test_two_commands_show_a_source_and_a_third_its_truth(tmp_path, source):
    words = ("--assets", 2, "--level", 0, "--source", source)
    said = commands.run("make-demo", tmp_path / "demo", *words).output
    run_printed(said, "a store of it:")
    score = json.loads(run_printed(said, "its score:", "--json"))
    assert len(score["assets"]) == 2
    for asset in score["assets"]:
        assert asset["displacement"] < 0.1
        assert min(asset["label_accuracy"], asset["valid_share"]) > 0.98
    store = open_store(tmp_path / "demo.zarr")
    held = HELD.get(source, ["youngs_modulus", "density", "poissons_ratio"])
    assert store.attributes["property_columns"] == held
    named = store.attributes["material_classes"]
    if source in (*ONE_FRAME, "voxels-hdf5"):
        assert named == []
        assert set(store.column("engine")) == {"field" if source == "voxels-hdf5" else "known"}
    else:
        assert named[:2] == (list(CLASSES[:2]) if source in HELD else ["jelly", "metal"])
    # Values, against the truth that was written beside them, where the labels are right.
    for asset in store:
        with np.load(tmp_path / "demo" / "truth" / f"{asset.asset_id}.npz") as truth:
            columns, values = truth["columns"].tolist(), truth["properties"]
        assert sorted(columns) == sorted(held)
        own = asset.properties_si[:, [held.index(name) for name in columns]]
        right = np.isclose(own, values, rtol=2e-3, atol=1e-3).all(axis=1)
        assert right.mean() > 0.97


def test_properties_of_plain_voxels_are_what_a_material_can_have():
    material = np.arange(7)
    properties = np.stack([np.full(7, 1e6), np.full(7, 900.0), np.linspace(0.2, 0.5, 7)], axis=1)
    columns = columns_of("voxels-npz", material, properties.astype(np.float32))
    assert list(columns) == NAMES
    for one in TABLE:
        values = columns[str(one["name"])]
        assert np.isfinite(values).all()
        assert (values > 0).all() or one["scale"] == "linear"
        assert values.min() >= one.get("least", -np.inf)
        assert values.max() <= one.get("most", np.inf)


@pytest.mark.parametrize("encoder", [name for name in get_args(Encoder) if name != "trellis"])
def test_latents_of_every_encoder_are_carried(tmp_path, encoder):
    words = ("--assets", 1, "--level", 0, "--encoder", encoder, "--latents", "material")
    run_printed(commands.run("make-demo", tmp_path / "demo", *words).output, "a store of it:")
    store = open_store(tmp_path / "demo.zarr")
    assert store.contents.latents.encoder == encoder
    assert store.contents.latents.channels == GRIDS[encoder][0]
    assert not store.contents.latents.standardised
    (asset,) = store
    (file,) = (tmp_path / "demo" / "slat").rglob("*.npz")
    with np.load(file) as latents:
        np.testing.assert_array_equal(asset.feats, latents["feats"])


TURN = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@pytest.mark.parametrize("source", ["pixieverse", "physxnet", "voxels-npz"])
def test_a_wrong_frame_of_any_source_is_caught(tmp_path, source):
    made = make_demo(tmp_path / "demo", 2, 0, levels=(0,), source=source)
    text = made.config.read_text()
    if "[align]" not in text:
        text += '\n[align]\nengine = "known"\n'
    root = made.directory / re.findall(r'^root = "(\w+)"$', text, re.M)[0]
    made.config.write_text(text.replace("[slat]", 'transform = "{id}.frame.npy"\n\n[slat]'))
    for wrong, expected in ((False, "good"), (True, "failed")):
        for truth in (made.directory / "truth").iterdir():
            with np.load(truth) as file:
                frame = file["transform"]
            np.save(root / f"{truth.stem}.frame.npy", TURN @ frame if wrong else frame)
        out = tmp_path / f"{expected}.zarr"
        commands.run("build-store", "--config", made.config, "--out", out)
        store = open_store(out)
        assert set(store.column("engine")) == {"known"}
        assert set(store.column("verdict")) == {expected}

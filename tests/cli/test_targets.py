"""No command writes into a store, or over what it reads."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from click.testing import Result
from support import commands
from support.synthetic import Made
from support.trees import tree


@pytest.fixture(scope="module")
def kept(undisturbed: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Sources, a store of them, its records, and predictions, which nobody may change."""
    dataset, store = undisturbed
    folder = tmp_path_factory.mktemp("kept")
    shutil.copytree(dataset.root, folder / "sources")
    shutil.copytree(store, folder / "s.zarr")
    shutil.copytree(store.with_name("s.manifests"), folder / "s.manifests")
    (folder / "predictions").mkdir()
    (folder / "predictions" / "a.npz").write_bytes(b"")
    np.save(folder / "p.npy", np.zeros((4, 3)))
    (folder / "ids.json").write_text("{}")
    definition = '[pixieverse]\nroot = "sources/pixieverse"\n[slat]\nroot = "sources/slat"\n'
    (folder / "d.toml").write_text(definition)
    return folder


@pytest.fixture
def folder(kept: Path, tmp_path: Path) -> Path:
    """Return a copy of all that, which may be changed."""
    return Path(shutil.copytree(kept, tmp_path / "copy"))


def run(line: str, folder: Path, code: int | None = None) -> Result:
    return commands.run(*line.replace("@", f"{folder}/").split(), code=code)


INTO_A_STORE = (
    "report @s.zarr --out @s.zarr/zarr.json",
    "report @s.zarr --out @s.zarr/new.html",
    "describe @s.zarr --out @s.zarr/zarr.json",
    "stats @s.zarr --csv @s.zarr/zarr.json",
    "stats @s.zarr --picture @s.zarr/p.png",
    "check-alignment --asset a --store @s.zarr --picture @s.zarr/a.png",
    "check-alignment --asset a --store @s.zarr --picture @s.zarr",
    "evaluate @predictions --store @s.zarr --csv @s.zarr/zarr.json",
    "export @s.zarr --format hdf5 --out @s.zarr/zarr.json",
    "export @s.zarr --format npz --out @s.zarr/npz",
    "publish @s.zarr --out @s.zarr/hub",
    "publish @s.zarr --out @s.zarr",
    "train @s.zarr --out @s.zarr",
    "train @s.zarr --out @s.zarr/run",
    "predict @s.zarr --checkpoint @p.npy --out @s.zarr/voxel",
    "decode-slat @s.zarr --out @s.zarr",
    "extract-slat @p.npy --out @s.zarr/slat",
    "transfer @p.npy --store @s.zarr --asset a --out @s.zarr/zarr.json",
    "align --pixieverse @sources/pixieverse --slat @sources/slat --out @s.zarr/zarr.json",
    # The next build of the outer store would remove it as a stray.
    "build-store --pixieverse @sources/pixieverse --slat @sources/slat --out @s.zarr/inner.zarr",
    "build-store --config @d.toml --out @s.zarr/asset/x/y --manifests @records --decoys 0",
    "make-demo @s.zarr/demo --assets 1",
    "subset @s.zarr --asset a --out @n.zarr --manifests @s.zarr/voxel",
)

OVER_WHAT_IS_READ = (
    "report @s.zarr --out @s.manifests/build.json",
    "report @s.zarr --manifests @s.manifests --out @s.manifests/assets.jsonl",
    "describe @s.zarr --out @s.manifests/build.json",
    "stats @s.zarr --csv @s.manifests/assets.jsonl",
    "evaluate @predictions --store @s.zarr --csv @predictions/a.npz",
    "evaluate --grids A=@ids.json --store @s.zarr --csv @ids.json",
    "evaluate @predictions --store @s.zarr --split-by @ids.json --csv @ids.json",
    "transfer @p.npy --store @s.zarr --asset a --out @p.npy",
    "align --pixieverse @sources/pixieverse --slat @sources/slat --out @sources/slat/a.npz",
    "predict @sources/slat --checkpoint @p.npy --out @sources/slat",
    "decode-slat @sources/slat --out @sources/slat",
    "subset @s.zarr --asset a --out @n.zarr --manifests @s.manifests",
)


@pytest.mark.parametrize("line", [*INTO_A_STORE, *OVER_WHAT_IS_READ])
def test_refused_in_words_and_nothing_changes(kept, line):
    before = tree(kept)
    done = run(line, kept)
    assert done.exit_code in (1, 2), done.output
    into = f"lies inside the store {kept}/s.zarr", f"{kept}/s.zarr is a store"
    words = into if line in INTO_A_STORE else ("the command reads", "holds the records of")
    assert any(one in " ".join(done.stderr.split()) for one in words), done.stderr
    assert tree(kept) == before


def test_neither_a_link_into_a_store_nor_a_device_is_replaced(folder):
    (folder / "link").symlink_to(folder / "s.zarr" / "zarr.json")
    assert "lies inside the store" in run("report @s.zarr --out @link", folder).stderr
    assert "is a pipe or device" in run("report @s.zarr --out /dev/null", folder).stderr
    assert Path("/dev/null").is_char_device()


def test_pictures_and_errors_beside_a_store_go_through_no_link(folder):
    (folder / "elsewhere").mkdir()
    (folder / "s.pictures").symlink_to(folder / "elsewhere")
    assert "s.pictures: is a link" in run("check-alignment @s.zarr --worst 2", folder, 1).stderr
    shutil.rmtree(folder / "s.manifests")
    (folder / "s.manifests").symlink_to(folder / "elsewhere")
    assert "s.manifests: is a link" in run("measure-errors @s.zarr", folder, 1).stderr
    assert not list((folder / "elsewhere").iterdir())


def test_sources_of_a_dataset_definition_are_not_overwritten(folder):
    before = tree(folder)
    for name in ("d.toml", "sources/slat/a.npz", "s.manifests/build.json"):
        run(f"align --config @d.toml --out @{name}", folder, code=2)
    assert tree(folder) == before
    for _ in range(2):
        run("align --config @d.toml --out @new.jsonl", folder, code=0)
    records = (folder / "new.jsonl").read_text().splitlines()
    assert [json.loads(line)["asset_id"] for line in records] == ["a", "b", "c"]


def test_new_files_below_what_is_read_and_beside_a_store_are_written(folder):
    sources = "--pixieverse @sources/pixieverse --slat @sources/slat"
    evaluate = "evaluate @predictions --store @s.zarr --split all"
    before = tree(folder)
    for line in (f"align {sources} --out @sources/slat/r.jsonl",
                 f"{evaluate} --csv @predictions/scores.csv"):  # fmt: skip
        assert "expected another path" not in run(line, folder).stderr
    for _ in range(2):
        run("describe @s.zarr --out @s.json", folder, code=0)
        run("stats @s.zarr --csv @sources/s.csv", folder, code=0)
        run("export @s.zarr --format npz --out @sources/npz", folder, code=0)
    assert before.items() <= tree(folder).items()


def test_predictions_lie_below_the_run_that_made_them(folder):
    (folder / "run" / "x").mkdir(parents=True)
    for out, refused in (("run/x", False), ("run/new", False), ("run", True)):
        words = run(f"predict @sources/slat --checkpoint @run --out @{out}", folder).stderr
        assert ("expected another path" in words) is refused, words

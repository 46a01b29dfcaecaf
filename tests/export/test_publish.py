"""What `slatprep publish` and `describe` write is read by a hub's own libraries, and from a hub."""

import glob
import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import mlcroissant
import numpy as np
import pytest
import zarr
from click.testing import Result
from support import commands
from support.faults import flip
from support.made_store import make_store, rewrite
from support.trees import tree

from slatprep import StoreError
from slatprep.export.croissant import Stated, describe, to_json
from slatprep.export.publish import card_of
from slatprep.pipeline.dataset import BuildSummary
from slatprep.records import Contents, Property
from slatprep.store import Store, open_store
from slatprep.store.layout import ARRAYS


def run(*words: object, code: int = 0) -> Result:
    return commands.run("publish", *words, code=code)


@pytest.fixture(scope="module")
def root(mixed_build: BuildSummary, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Publish a store and shards of it, as two datasets of one owner."""
    folder = tmp_path_factory.mktemp("hub") / "me"
    for name, data in (("store", "store"), ("shards", "webdataset")):
        words = (mixed_build.store, "--out", folder / name, "--data", data)
        result = run(*words, "--license", "CC-BY-4.0", "--name", "A | B: <i>'c'", "--pictures", 2)
        assert "--cite-as, --url, --date-published" in result.stderr
    return folder.parent


def test_every_file_has_its_checksum_and_the_store_is_the_same(root, mixed_build):
    for name in ("store", "shards"):
        folder = root / "me" / name
        lines = (folder / "SHA256SUMS").read_text().splitlines()
        sums = dict(line.split("  ")[::-1] for line in lines)
        files = {one.relative_to(folder).as_posix() for one in folder.rglob("*") if one.is_file()}
        assert files - sums.keys() == {"SHA256SUMS", "index.json"}
        for file, digest in sums.items():
            assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest
    assert tree(root / "me" / "store" / "mixed.zarr") == tree(Path(str(mixed_build.store)))


def test_the_card_is_read_by_the_hubs_library(root):
    hub = pytest.importorskip("huggingface_hub")
    card = hub.DatasetCard.load(root / "me" / "shards" / "README.md")
    assert card.data.license == "cc-by-4.0" and card.data.pretty_name == "A | B: <i>'c'"
    assert card.data.to_dict()["configs"][0]["data_files"] == "data/*.tar"
    assert "A \\| B: &lt;i&gt;'c'" in card.text and "(assets.png)" in card.text
    assert "| (unknown) | 5 |" in card.text
    document = json.loads((root / "me" / "store" / "croissant.json").read_text())
    assert document["license"] == "https://spdx.org/licenses/CC-BY-4.0"
    assert document["distribution"][0]["contentUrl"] == "mixed.zarr/zarr.json"


def test_it_replaces_what_it_wrote_and_not_by_a_damaged_store(copy, tmp_path):
    words = (copy, "--out", tmp_path / "hub", "--pictures", 0)
    for _ in range(2):
        assert run(*words, "-q").output == ""
    before = tree(tmp_path / "hub")
    shard = copy / "voxel/feats/c/0/0"
    flip(shard, 100)
    told = run(*words, code=1).stderr
    assert tree(tmp_path / "hub") == before
    assert "voxel/feats/c/0/0: its bytes changed" in told
    shard.unlink()
    shard.symlink_to(tmp_path / "hub" / "README.md")
    assert "voxel/feats/c/0/0: is a link" in run(*words, code=1).stderr


def test_only_assets_that_went_into_shards_are_counted_and_drawn(copy, tmp_path, monkeypatch):
    rewrite(copy, "asset/verdict", 0, "failed")
    drawn: list[list[str]] = []
    monkeypatch.setattr(
        "slatprep.inspect.pictures.write.sheet_of",
        lambda store, ids: drawn.append(sorted(ids)) or b"",  # type: ignore[func-returns-value]
    )
    whole = run(copy, "--out", tmp_path / "v", "--verdict", "good", code=2)
    assert "slatprep subset" in whole.stderr
    words = (copy, "--data", "webdataset", "--pictures", 9, "--json")
    left = json.loads(run(*words, "--out", tmp_path / "hub").stdout)["assets"]
    first, *others = open_store(copy).ids
    assert left == len(others) and drawn == [sorted(others)]
    run(*words, "--out", tmp_path / "failed", "--verdict", "failed")
    assert drawn[1:] == [[first]]
    card = (tmp_path / "hub" / "README.md").read_text()
    table = card.partition("## What is in it\n\n")[2].partition("\n\n")[0]
    rows = [line.strip("| ").split(" | ") for line in table.splitlines()[2:]]
    assert rows and all(row[5] == "0" for row in rows), table


def test_a_card_says_what_is_known_and_what_is_not(mixed_build):
    store = open_store(mixed_build.store)
    card = card_of(store, Stated(), "s.zarr", [])
    assert "| density | kg/m³ | log10 |" in card and "| youngs_modulus | Pa | log10 |" in card
    assert "Not stated: ask" in card
    linked = card_of(store, Stated(license="https://a.org/l", cite_as="```me"), "s.zarr", [])
    assert 'license: "other"' in linked and 'license_link: "https://a.org/l"' in linked
    assert "```\n'''me\n```" in linked


def test_no_category_is_a_control_character_or_the_row_of_all(copy):
    word = "cup\x1b[2J\x9b\u202e\n"
    rewrite(copy, "asset/category", slice(0, 2), np.array([word, "all"], object))
    store = open_store(copy)
    card = card_of(store, Stated(name="a\x85b", cite_as="me\x1b"), "s.zarr", [])
    text = to_json(describe(store))
    for made in (card, text):
        assert all(c.isprintable() or c == "\n" for c in made)
    assert "cup\\u001b" in card and '\n| "all" | 1 | ' in card and "\n| all | 5 | " in card
    assert json.loads(text)["recordSet"][-1]["data"][0]["assets/category"] == word
    cited = "M\u00fcller, A.\u00a0B."
    assert cited in card_of(store, Stated(name="a", cite_as=cited), "s.zarr", [])


def test_what_is_stated_is_what_it_says(store, tmp_path):
    for words, said in (
        (("--date-published", "2026-99-99"), "'2026-99-99'; expected a day such as 2026-01-31"),
        (("--date-published", "20260131"), "expected a day such as 2026-01-31"),
        (("--url", "my page"), "url is 'my page'; expected"),
        (("--url", "ftp:"), "expected a page such as https://example.org/data"),
        (("--license", "foo bar"), "license is 'foo bar'; expected an SPDX identifier"),
        (("--dataset-version", "1.x"), "version is '1.x'; expected three numbers"),
    ):
        assert said in run(store, "--out", tmp_path / "hub", *words, code=2).stderr, words
        assert said in commands.refused("describe", store, *words), words
    for day in ("2026-01-31", "2026-01-31T12:00:00Z"):
        commands.run("describe", store, "--date-published", day, "--url", "https://a.org/b")


def test_a_store_is_read_from_the_hub_at_the_commit_that_was_opened(root, mixed_build, tmp_path):
    pytest.importorskip("huggingface_hub")
    (tmp_path / "empty").mkdir()
    folders = [str(root / "me" / "store"), str(tmp_path / "empty")]
    code = (
        "import hashlib, json, os, pathlib, sys\n"
        f"sys.path.insert(0, {str(Path(__file__).parents[1])!r})\n"
        "from support.published_hub import PublishedHub\n"
        f"hub, (first, last) = PublishedHub(), map(pathlib.Path, {folders!r})\n"
        "hub.publish('me/store', first)\n"
        "os.environ['HF_ENDPOINT'] = hub.address\n"
        "import slatprep\n"
        "from slatprep.inspect.verify import verify_store\n"
        "url = 'hf://datasets/me/store/mixed.zarr'\n"
        "opened, sound = slatprep.open_store(url), verify_store(url).ok\n"
        "faults = []\n"
        "for name in ('store/none.zarr', 'nobody/x.zarr'):\n"
        "    try: slatprep.open_store(f'hf://datasets/me/{name}')\n"
        "    except slatprep.StoreError as error: faults.append(str(error))\n"
        "hub.publish('me/store', last)\n"
        "sums = [hashlib.sha256(a.properties.tobytes() + a.grid_material.tobytes()).hexdigest()"
        " for a in opened]\n"
        "print(json.dumps([opened.ids, sums, sound, faults]))\n"
    )
    none = dict.fromkeys(("HTTP_PROXY", "HTTPS_PROXY", "http_proxy", "https_proxy"), "")
    variables = os.environ | none | {"HF_HOME": str(tmp_path), "HF_HUB_DISABLE_XET": "1"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, env=variables)
    assert done.returncode == 0, done.stderr
    ids, sums, sound, faults = json.loads(done.stdout.splitlines()[-1])
    store = open_store(mixed_build.store)
    assert ids == store.ids and sound
    for asset, digest in zip(store, sums, strict=True):
        content = asset.properties.tobytes() + asset.grid_material.tobytes()
        assert hashlib.sha256(content).hexdigest() == digest
    assert len(faults) == 2 and all("is not a slatprep store" in fault for fault in faults)


def test_shards_are_a_dataset_of_the_hubs_library(root, mixed_build, tmp_path, monkeypatch):
    """`make hub` installs the library `datasets`, and a job of continuous integration runs it."""
    why = "with pyarrow it is 190 MB, and tests' environment would be above 2.5 GB; see make hub"
    datasets = pytest.importorskip("datasets", reason=f"no library datasets: {why}")
    loaded = datasets.load_dataset(
        str(root / "me" / "shards"), split="train", cache_dir=str(tmp_path)
    ).with_format("numpy")
    store = open_store(mixed_build.store)
    assert [row["json"]["asset_id"] for row in loaded] == store.ids
    for row, asset in zip(loaded, store, strict=True):
        np.testing.assert_array_equal(row["npz"]["coords"], asset.coords)
        np.testing.assert_array_equal(row["npz"]["properties"], asset.properties)


STATED = {
    "license": "https://creativecommons.org/licenses/by/4.0/",
    "url": "https://example.org/dataset",
    "cite_as": "Someone (2026)",
    "date_published": "2026-01-31",
}


def described(store: Store, folder: Path, **stated: str) -> mlcroissant.Dataset:
    """Return a store's description as mlcroissant reads it, which raises where it is invalid."""
    path = folder / "croissant.json"
    path.write_text(to_json(describe(store, Stated(**stated))), encoding="utf-8")
    return mlcroissant.Dataset(jsonld=path)


def test_croissant_is_valid_without_a_warning_and_its_records_are_the_store_s(
    store, tmp_path, caplog
):
    dataset = described(open_store(store), tmp_path, **STATED)
    assert dataset.metadata.ctx.issues.report() == ""
    assert caplog.text == ""
    assert dataset.metadata.name == store.stem
    assert {node.id for node in dataset.metadata.distribution} >= {layout.name for layout in ARRAYS}
    group = zarr.open_group(store, mode="r")
    assets = list(dataset.records("assets"))
    assert [row["assets/id"] for row in assets] == list(group["asset/id"][:])
    fitness = [row["assets/fitness"] for row in assets]
    np.testing.assert_array_equal(fitness, group["asset/fitness"][:])
    offsets = group["asset/offset"][:]
    assert [row["assets/first_row"] for row in assets] == offsets[:-1].tolist()
    assert [row["assets/end_row"] for row in assets] == offsets[1:].tolist()
    materials = {row["materials/id"]: row["materials/name"] for row in dataset.records("materials")}
    assert [materials[k] for k in range(8)] == group.attrs["material_classes"]
    for row in dataset.records("properties"):
        stated = group.attrs["normalization"][row["properties/name"]]
        assert (row["properties/lo"], row["properties/hi"]) == (stated["lo"], stated["hi"])


def test_croissant_says_what_a_store_of_other_contents_holds(tmp_path):
    density, hue = Property("density", "g/cm^3", True), Property("hue", "1", False)
    for table, classes, said in (
        ((density, hue), ("oak", "elm"), "its density, hue and material class, normalised"),
        ((density,), (), "its density, normalised"),
    ):
        store = tmp_path / f"{len(table)}.zarr"
        make_store(store, Contents(table, classes))
        opened = open_store(store)
        text, card = to_json(describe(opened)), card_of(opened, Stated(), "s.zarr", [])
        assert said in text and said in card
        sets = {one.id for one in described(opened, tmp_path).metadata.record_sets}
        assert sets == {"properties", "assets", *(["materials"] if classes else [])}
        assert "| density | g/cm³ | log10 |" in card and "youngs_modulus" not in card
        assert not any(word in text for word in ("PixieVerse material", "Young", "PhysGaussian"))


@pytest.mark.parametrize("other", ["voxel/feats/zarr.json", "voxel/feats/c/0/0", None])
def test_croissant_states_no_digest_of_a_root_that_is_another(copy, other):
    root = copy / "zarr.json"
    store, kept = open_store(copy), root.read_bytes()
    describe(store)
    more = json.loads(kept)
    more["attributes"]["manifest"] = "0" * 64
    root.write_bytes((copy / other).read_bytes() if other else json.dumps(more).encode())
    with pytest.raises(StoreError, match=r"zarr\.json: (is not what was opened|cannot be read)"):
        describe(store)
    root.write_bytes(kept)
    (digest,) = (one["sha256"] for one in describe(store)["distribution"] if "sha256" in one)
    assert digest == hashlib.sha256(kept).hexdigest()


def test_croissant_describes_figures_that_are_not_numbers(store, tmp_path):
    opened = open_store(store)
    figures = opened.column("inlier_rmse").copy()
    figures[0] = np.nan
    read = opened.column
    opened.column = lambda name: figures if name == "inlier_rmse" else read(name)
    rows = list(described(opened, tmp_path).records("assets"))
    assert np.isnan(rows[0]["assets/inlier_rmse"]) and rows[1]["assets/inlier_rmse"] == figures[1]


def test_describe_writes_where_the_files_are_found(store, tmp_path):
    out = store.parent / "description" / "croissant.json"
    told = commands.document("describe", store, "--out", out, "--name", "mine")
    assert (told["command"], told["path"], told["ok"]) == ("describe", str(out), True)
    document = json.loads(out.read_text("utf-8"))
    assert (document["@type"], document["name"]) == ("sc:Dataset", "mine")
    for entry in document["distribution"]:
        if "contentUrl" in entry:
            assert (out.parent / entry["contentUrl"]).is_file()
        else:  # pathlib's own ** finds folders alone
            found = glob.glob(str(out.parent / entry["includes"]), recursive=True)  # noqa: PTH207
            files = [Path(path) for path in found if Path(path).is_file()]
            assert any(path.name == "zarr.json" for path in files)
            # Of an array of one value alone, its fill value, Zarr writes no chunk.
            assert len(files) >= (2 if entry["@id"].startswith("voxel/") else 1)
    words = ("--location", "https://example.org/s.zarr/", "--license", STATED["license"])
    printed = commands.run("describe", store, *words)
    assert "also ask for --cite-as, --url, --date-published" in printed.stderr
    (root, *_) = json.loads(printed.stdout)["distribution"]
    assert root["contentUrl"] == "https://example.org/s.zarr/zarr.json"

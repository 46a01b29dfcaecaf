"""Dataset definitions: what is read from them, and what is said of a wrong one."""

from pathlib import Path

import pytest

from slatprep.errors import ConfigError
from slatprep.parameters import PRESETS, AlignParameters
from slatprep.parameters.files import load_parameters

MINIMAL = """name = "mine"

[pixieverse]
root = "grids"

[slat]
root = "latents"
"""
TRAIN = '[normalize]\nobjects = "train"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "grids").mkdir()
    (tmp_path / "latents").mkdir()
    return tmp_path


def write(folder: Path, text: str) -> Path:
    path = folder / "mine.toml"
    path.write_text(text, encoding="utf-8")
    return path


def message_of(path: Path | None, **arguments: object) -> str:
    with pytest.raises(ConfigError) as caught:
        load_parameters(path, **arguments)
    return str(caught.value)


def test_minimal_file_leaves_everything_else_at_its_default(folder):
    path = write(folder, MINIMAL)
    parameters = load_parameters(path)
    assert parameters.name == "mine"
    assert parameters.align == AlignParameters()
    assert parameters.normalize.ranges == "dataset"
    assert load_parameters(str(path)) == parameters


def test_paths_are_relative_to_the_file(folder, tmp_path_factory, monkeypatch):
    """And not to the working directory."""
    (folder / "map.csv").touch()
    (folder / "ranges.toml").touch()
    tables = '[pairing]\nmap = "map.csv"\n[normalize]\nranges = "./ranges.toml"\n'
    patterns = 'pattern = ["a/{id}.npz", "b/{id}.npz"]\n'
    path = write(folder, MINIMAL + patterns + tables)
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    parameters = load_parameters(path)
    assert parameters.pixieverse.root == folder / "grids"
    assert parameters.pairing.map == folder / "map.csv"
    assert parameters.normalize.ranges == str(folder / "ranges.toml")
    assert parameters.slat.pattern == ("a/{id}.npz", "b/{id}.npz")


def test_options_win_over_the_file(folder):
    (folder / "other").mkdir()
    path = write(folder, MINIMAL + '[normalize]\nranges = "dataset"\n')
    given = {"pixieverse": {"root": str(folder / "other")}, "normalize": {"ranges": "pixie"}}
    parameters = load_parameters(path, given)
    assert parameters.pixieverse.root == folder / "other"
    assert parameters.slat.root == folder / "latents"
    assert parameters.normalize.ranges == "pixie"


def test_preset_replaces_tables_and_leaves_ranges_unless_it_has_its_own(folder):
    tables = '[align]\nengine = "small_gicp"\nradius = 2.5\n[normalize]\nranges = "p2-p98"\n'
    path = write(folder, MINIMAL + tables)
    assert load_parameters(path).align.radius == 2.5
    parameters = load_parameters(path, preset="paper")
    assert parameters.align == PRESETS["paper"].align
    assert parameters.sample == PRESETS["paper"].sample
    ranges = [load_parameters(path, preset=p).normalize.ranges for p in (None, "default", "paper")]
    assert ranges == ["p2-p98", "p2-p98", "pixie"]
    given = load_parameters(path, {"normalize": {"ranges": "dataset"}}, "paper")
    assert given.normalize.ranges == "dataset"


def test_lists_of_ids_lie_beside_the_definition(folder):
    (folder / "lists.json").write_text("{}")
    named = f"{TRAIN}shares = [1, 0, 0]\nsplit_by = "
    found = load_parameters(write(folder, MINIMAL + named + '"lists.json"\n')).normalize
    assert found.split_by == str(folder / "lists.json") and found.shares == (1.0, 0.0, 0.0)
    for rule in ("pixie", "category:tree", "hash"):
        path = write(folder, MINIMAL + named + f'"{rule}"\n')
        assert load_parameters(path).normalize.split_by == rule


@pytest.mark.parametrize(("addition", "words"), [
    ('[align]\nengin = "field"\n', ("align.engin", "did you mean 'engine'", "radius")),
    ('[normalize]\nranges = "p99-p1"\n', ("normalize", "p99-p1", "the lower first")),
    ('[normalize]\nranges = "p1-p101"\n', ("normalize", "p1-p101", "p0 to p100")),
    ('[normalize]\nranges = "p1-pnan"\n', ("normalize.ranges", "does not exist", "p1-p99")),
    ('[normalize]\nsplit_by = "pixie"\n', ("normalize", "objects = 'train'")),
    (f'{TRAIN}ranges = "pixie"\n', ("normalize", "percentiles of it where objects")),
    (f"{TRAIN}shares = [0.5, 0.5, 0.5]\n", ("normalize", "add up to 1")),
    (f'{TRAIN}split_by = "no.json"\n', ("normalize.split_by", "no.json", "does not exist")),
    ('[align]\nengine = "magic"\n', ("align.engine", "'magic'", "'open3d'")),
    ('[align]\nengine = "open3d"\nmodel = "affine"\n', ("align", "'rigid' or 'auto'", "open3d")),
    ('[pairing]\nmap = ""\n', ("pairing.map is empty", "expected a path")),
    ('[[also]]\nroot = ""\n', ("also.root is empty",)),
    ("[align]\nradius = true\n", ("align.radius", "True", "number")),
    ('[align]\nradius = "3"\n', ("align.radius", "'3'", "number")),
    ("[align]\nradius = -1.0\n", ("align.radius", "-1.0", "greater than 0")),
    ("[align]\nradius = nan\n", ("align.radius", "nan", "finite number")),
    ("[align]\nscale_bounds = [1.2, 1.6]\n", ("align.scale_bounds.0", "1.2", "or equal to 1")),
    ("align.radius = 1.5\n", ("slat.align", "unknown key")),
    ("[alingment]\n", ("alingment", "unknown key", "did you mean 'align'")),
    ("[store]\ncompression_level = 23\n", ("store.compression_level", "or equal to 22")),
    ("[store]\nvoxel_chunk = 2000000\n", ("store.voxel_chunk", "equal to 1048576")),
    ("[store]\nvoxel_chunks_per_shard = 2000000\n", ("per_shard", "equal to 1048576")),
    ("[store]\nvoxel_chunks_per_shard = 100000\n", ("store: got", "at most 268435456 rows")),
    ("[store]\ngrid_assets_per_shard = 70000\n", ("store.grid_assets", "equal to 65536")),
    ("[sample]\nvote_width = 1e300\n", ("sample.vote_width", "equal to 1000")),
    ("[sample]\nvote_width = 1e-300\n", ("sample.vote_width", "greater than 0")),
    ("x = " + "[" * 3000 + "]" * 3000, ("not valid TOML", "nested too deeply")),
    ('[pairing]\nmap = "absent.csv"\n', ("pairing.map", "absent.csv", "does not exist")),
    ('[normalize]\nranges = "pixi"\n', ("normalize.ranges", "pixi", "dataset, pixie")),
    ('pattern = "{id}.npz"\n', ("slat.pattern", "'{id}.npz'", "array")),
    ('"group" = 3\n', ("slat.group", "3", "string")),
    ('[normalize]\nranges = "\\u0000"\n', ("normalize.ranges", "without NUL")),
    ('[normalize]\nsplit_by = "\\u0000.json"\n', ("normalize.split_by", "without NUL")),
    ('[[also]]\nroot = "\\u0000"\n', ("also.[].root", "without NUL")),
    ("[align]\nicp_iterations = " + "9" * 23 + "\n", ("align.icp_iterations", "23 digits")),
    ("[align]\nicp_iterations = " + "9" * 5000 + "\n", ("cannot be read", "4300 digits")),
    (".".join(["a"] * 3000) + " = 1\n", ("nested too deeply",)),
    ('[pairing]\nmap = "~nobody-here/x"\n', ("pairing.map", "~nobody-here/x")),
])  # fmt: skip
def test_fault_is_reported_with_file_key_value_and_what_is_allowed(folder, addition, words):
    path = write(folder, MINIMAL + addition)
    message = message_of(path)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message
    for word in words:
        assert word in message


def test_missing_root_says_both_ways_to_give_it(folder):
    message = message_of(write(folder, '[pixieverse]\nroot = "grids"\n'))
    assert "slat.root: not given" in message
    assert "--slat" in message and "[slat]" in message
    assert "--pixieverse" in message_of(None)
    path = write(folder, '[pixieverse]\nsample = "0"\n[slat]\nroot = "latents"\n')
    assert message_of(path).startswith(f"{path}: pixieverse.root: not given")


def test_fault_in_an_option_names_the_option(folder):
    path = write(folder, MINIMAL)
    message = message_of(path, overrides={"slat": {"root": str(folder / "nowhere")}})
    assert message.startswith("option --slat: slat.root: ")
    assert "nowhere does not exist" in message
    path = write(folder, "slat = 3\n")
    message = message_of(path, overrides={"slat": {"root": "x"}})
    assert message.startswith(f"{path}: slat: ") and "table" in message


def test_a_byte_order_mark_is_no_part_of_a_definition(folder):
    path = write(folder, MINIMAL)
    marked = folder / "marked.toml"
    marked.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert load_parameters(marked) == load_parameters(path)


def test_what_is_no_definition_is_named(folder):
    path = write(folder, MINIMAL + "[align\n")
    message = message_of(path)
    assert message.startswith(f"{path}: not valid TOML") and "line 8" in message
    assert "texts need quotes" not in message
    assert "line 8" in message and "texts need quotes" in message_of(write(folder, "name = pixie"))
    assert "absent.toml" in message_of(folder / "absent.toml")
    (folder / "binary.toml").write_bytes(b"\xff\xfe\x00")
    assert "binary.toml" in message_of(folder / "binary.toml")
    message = message_of(write(folder, MINIMAL), preset="papr")
    assert "papr" in message and "paper" in message


def test_a_fault_of_several_tables_is_told_without_the_document(tmp_path):
    file = tmp_path / "d.toml"
    file.write_text('[pixieverse]\nroot = "p"\nsamples = "merge"\n[slat]\nroot = "s"\n')
    told = rf"^{file}: expected pixieverse\.samples of one, first or all with --consensus"
    with pytest.raises(ConfigError, match=told):
        load_parameters(file, {"consensus": {"settle": True}})

"""Adapters of other packages: whatever they raise or return is named as theirs."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from support.installed import package

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import SlatSource
from slatprep.readers import read_latents
from slatprep.readers.adapters import FoundField, Holding, made_by, source_adapter
from slatprep.readers.contents import latent_space
from slatprep.readers.foreign import ForeignLatents, ForeignSource
from slatprep.readers.pixieverse import PixieVerse
from slatprep.readers.voxel_sets import field_of_voxels
from slatprep.records import PIXIEVERSE, PROPERTIES, TRELLIS, Units

THEIRS = r"adapter 'mine' of theirs 1\.0: (gives|raises) "


def source(**methods: Any) -> Any:
    return ForeignSource(SimpleNamespace(**methods), "mine", "theirs 1.0")


def of_file(read: Any, **changes: object) -> dict[str, Any]:
    return {"sources": (replace(read.sources[0], **changes),)}


Change = Callable[[Any], dict[str, Any] | None]
BAD_FIELDS: dict[str, Change] = {
    "nothing": lambda f: None,
    "NaN": lambda f: {"properties": f.properties * np.nan},
    "below 0": lambda f: {"properties": -f.properties},
    "infinite": lambda f: {"properties": f.properties + np.float32(np.inf)},
    "another type": lambda f: {"properties": f.properties.astype(np.float64)},
    "a column less": lambda f: {"properties": f.properties[:, :2]},
    "a row less": lambda f: {"properties": f.properties[:-1]},
    "another table": lambda f: {"table": f.table[:1], "properties": f.properties[:, :1].copy()},
    "no such class": lambda f: {"material": f.material + np.uint8(100)},
    "classes of none": lambda f: {"classified": False, "material": f.material * 0 + np.uint8(1)},
    "out of the grid": lambda f: {"voxels": f.voxels + np.uint8(70)},
    "one voxel": lambda f: {"voxels": np.zeros_like(f.voxels)},
    "not occupied": lambda f: {"occupancy": np.zeros_like(f.occupancy)},
    "another grid": lambda f: {"occupancy": np.ones((32, 32, 32), bool)},
    "empty": lambda f: {k: getattr(f, k)[:0] for k in ("voxels", "material", "properties")},
    "no files": lambda f: {"sources": ()},
    "warnings of objects": lambda f: {"warnings": (object(),)},
    "bounds of objects": lambda f: {"bounds": {"a": object()}},
    "a path of surrogates": lambda f: of_file(f, path="a\udcff"),
    "a size beyond numbers": lambda f: of_file(f, size=2**70),
    "warnings of surrogates": lambda f: {"warnings": ("a\udcff",)},
    "a warning without end": lambda f: {"warnings": ("a" * 10_000_000,)},
    "more unphysical voxels than numbers": lambda f: {"unphysical": 2**70},
    "unphysical voxels below 0": lambda f: {"unphysical": -1},
    "a frame of NaN": lambda f: {"frame": np.full((4, 4), np.nan)},
    "a sheared frame": lambda f: {"frame": np.eye(4) + np.eye(4, k=1)},
}
BAD_SLATS: dict[str, Change] = {
    "nothing": lambda s: None,
    "NaN": lambda s: {"feats": s.feats * np.nan},
    "channels": lambda s: {"feats": s.feats[:, :5]},
    "rows": lambda s: {"feats": s.feats[:-1]},
    "out of the grid": lambda s: {"coords": s.coords + np.uint8(100)},
    "another grid": lambda s: {"resolution": 32},
    "twice": lambda s: {"coords": np.zeros_like(s.coords)},
    "another type": lambda s: {"coords": s.coords.astype(np.int64)},
    "no files": lambda s: {"sources": ()},
    "a digest of bytes": lambda s: of_file(s, sha256=b"0" * 64),
    "a digest of surrogates": lambda s: of_file(s, sha256="\udcff" * 64),
    "a role that is none": lambda s: of_file(s, role="script"),
    "a source that is none": lambda s: of_file(s, source=-1),
    "standardised perhaps": lambda s: {"standardised": "no"},
    "a grid without end": lambda s: {"resolution": "x" * 10**6},
}


def refused(adapter: Any, *arguments: Any) -> None:
    """Hold that what an adapter gives is refused, in words that are theirs and few."""
    with pytest.raises(InputError, match=THEIRS) as caught:
        adapter.read(*arguments)
    assert len(str(caught.value).encode()) < 2000
    assert "pydantic" not in str(caught.value) and "validation error" not in str(caught.value)


@pytest.mark.parametrize("case", BAD_FIELDS)
def test_a_field_that_is_none_is_refused(make_pair, case):
    pair = make_pair()
    sound = PixieVerse().read(pair, 0.1)
    field = source(read=lambda *_: sound).read(pair, 0.1)
    np.testing.assert_array_equal(field.voxels, sound.voxels)
    change = BAD_FIELDS[case](sound)
    raw = change and replace(sound, converted=False, **change)
    refused(source(read=lambda *_: raw), pair, 0.1)


@pytest.mark.parametrize(("stated", "in_file"), [
    ({"density": "g/cm^3"}, lambda e, d, r: (e, d / 1000, r)),
    ({"youngs_modulus": "log10 Pa"}, lambda e, d, r: (np.log10(e), d, r)),
])  # fmt: skip
def test_stated_units_convert_once_and_values_are_compared_after_it(make_pair, stated, in_file):
    pair = make_pair()
    sound = PixieVerse().read(pair, 0.1)
    in_units = replace(pair, roots=replace(pair.roots, units=Units(**stated)))
    given = np.stack(in_file(*sound.properties.T), axis=1)

    def helped(pair, max_unphysical):
        return field_of_voxels(
            pair.grid, sound.voxels, given, material=sound.material, roots=pair.roots,
            sources=sound.sources, max_unphysical=max_unphysical,
        )  # fmt: skip

    def alone(pair, max_unphysical):
        return replace(sound, properties=given, converted=False)

    (unit,) = stated.values()
    for read in (helped, alone):
        field = source(read=read).read(in_units, 0.1)
        np.testing.assert_allclose(field.properties, sound.properties, rtol=1e-5)
        with pytest.raises(InputError, match=f"look like .*{re.escape(unit)}"):
            source(read=read).read(pair, 0.1)
    given[0, 1] = 3e37 if "density" in stated else np.inf
    refused(source(read=alone), in_units, 0.1)
    assert source(read=helped).read(in_units, 0.5).unphysical == 1


def test_a_field_in_an_eighth_of_the_grid_and_a_class_unlike_itself_are_told(make_pair):
    block = np.indices((5, 5, 5)).reshape(3, -1).T

    def read(pair, max_unphysical):
        values, files = np.tile([2e5, 2700, 0.4], (125, 1)), PixieVerse().read(pair, 0.1).sources
        labels = np.full(125, PIXIEVERSE.classes.index(name))
        return field_of_voxels(
            pair.grid, block, values, roots=pair.roots, sources=files, material=labels
        )

    name = "jelly"
    (told,) = source(read=read).read(make_pair(), 0.1).warnings
    assert "no coordinate is above 4, as on a grid of 32^3" in told
    name = "metal"
    with pytest.raises(InputError, match=r"class metal has .*no metal is so soft"):
        source(read=read).read(make_pair(), 0.1)


@pytest.mark.parametrize("case", BAD_SLATS)
def test_latents_that_are_none_are_refused(make_pair, case):
    sound = read_latents(make_pair())
    change = BAD_SLATS[case](sound)
    told = SimpleNamespace(read=lambda *_: change and replace(sound, **change))
    refused(ForeignLatents(told, "mine", "theirs 1.0"), "a", "b", "", TRELLIS)


@pytest.mark.parametrize("error", [KeyError("boom"), SystemExit(3), GeneratorExit()])
def test_whatever_is_raised_is_theirs(make_pair, error):
    call = Mock(side_effect=error)
    adapter = source(describe=call, read=call, find=call)
    for ask in (
        lambda: adapter.describe(None),
        lambda: adapter.read(make_pair(), 0.1),
        lambda: list(adapter.find(None, None)),
        lambda: adapter.patterns,
    ):
        with pytest.raises(InputError, match=THEIRS):
            ask()


@pytest.mark.parametrize("held", [
    None,
    Holding(properties=(1, 2)),  # type: ignore[arg-type]
    Holding(properties=()),
    Holding(properties=(PROPERTIES[0],) * 2),
    Holding(classes="abc"),  # type: ignore[arg-type]
    Holding(classes=("A\x1b[2J",)),
    Holding(classes=tuple(f"c{k}" for k in range(255))),
])  # fmt: skip
def test_what_a_source_cannot_hold_is_refused(held):
    with pytest.raises(InputError, match=THEIRS):
        source(describe=lambda _: held).describe(None)


def _half_found(*_: object) -> Iterator[FoundField]:
    yield FoundField("a", "a.npy")
    raise KeyError("boom")


@pytest.mark.parametrize("found", [_half_found, lambda *_: None, lambda *_: [5], None])
def test_what_is_no_field_is_not_found(found):
    with pytest.raises(InputError, match=THEIRS):
        list(source(find=found).find(None, None))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    codes = {
        "torn": "def (",
        "boom": "raise RuntimeError('at import')",
        "leave": "import sys; sys.exit(3)",
        "borrowed": "from slatprep.records import TRELLIS\nclass made: space = TRELLIS",
    }
    modules = {f"adapter_{name}": code for name, code in codes.items()}
    lines = "".join(f"{name} = adapter_{name}:made\n" for name in (*codes, "gone"))
    points = f"[slatprep.sources]\n{lines}[slatprep.latents]\n{lines}"
    with package(tmp_path, "theirs", modules, points, monkeypatch):
        yield


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("name", ["torn", "boom", "leave", "gone"])
def test_an_adapter_that_cannot_be_loaded_is_named(name):
    with pytest.raises(ConfigError, match=rf"adapter '{name}' .* cannot be loaded"):
        source_adapter(name)


@pytest.mark.usefixtures("installed")
def test_latents_have_the_name_of_their_adapter(tmp_path):
    """By another name they would be read by that one's adapter."""
    with pytest.raises(InputError, match="gives latents of 'trellis'; expected its own name"):
        latent_space(SlatSource(tmp_path, encoder="borrowed"))


def test_a_library_is_told_of_the_adapter_alone_that_reads_by_it():
    assert made_by("slatprep.sources", "parts").startswith("trimesh ")
    assert made_by("slatprep.sources", "vomp") == made_by("slatprep.latents", "parts") == ""

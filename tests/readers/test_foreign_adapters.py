"""Adapters of other packages: whatever they raise or return is named as theirs."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.installed import package

from slatprep.errors import ConfigError, InputError
from slatprep.parameters import SlatSource
from slatprep.readers import read_latents
from slatprep.readers.adapters import FoundField, Holding, source_adapter
from slatprep.readers.contents import latent_space
from slatprep.readers.foreign import guarded
from slatprep.readers.pixieverse import PixieVerse
from slatprep.records import PROPERTIES, TRELLIS, AssetPair

MakePair = Callable[..., AssetPair]
THEIRS = r"adapter 'mine' of theirs 1\.0: (gives|raises) "

FIELDS: dict[str, Callable[[Any], Any]] = {
    "nothing": lambda field: None,
    "a list": lambda field: [1, 2],
    "NaN": lambda field: replace(field, properties=field.properties * np.nan),
    "below 0": lambda field: replace(field, properties=-field.properties),
    "infinite": lambda field: replace(field, properties=field.properties + np.float32(np.inf)),
    "another type": lambda field: replace(field, properties=field.properties.astype(np.float64)),
    "a column less": lambda field: replace(field, properties=field.properties[:, :2]),
    "a row less": lambda field: replace(field, properties=field.properties[:-1]),
    "another table": lambda f: replace(f, table=f.table[:1], properties=f.properties[:, :1].copy()),
    "no such class": lambda field: replace(field, material=field.material + np.uint8(100)),
    "classes of none": lambda f: replace(
        f, classified=False, material=f.material * 0 + np.uint8(1)
    ),
    "out of the grid": lambda field: replace(field, voxels=field.voxels + np.uint8(70)),
    "one voxel": lambda field: replace(field, voxels=np.zeros_like(field.voxels)),
    "not occupied": lambda field: replace(field, occupancy=np.zeros_like(field.occupancy)),
    "another grid": lambda field: replace(field, occupancy=np.ones((32, 32, 32), bool)),
    "empty": lambda f: replace(
        f, voxels=f.voxels[:0], material=f.material[:0], properties=f.properties[:0]
    ),
    "no files": lambda field: replace(field, sources=()),
    "warnings of objects": lambda field: replace(field, warnings=(object(),)),
    "bounds of objects": lambda field: replace(field, bounds={"a": object()}),
    "a path of surrogates": lambda field: replace(
        field, sources=(replace(field.sources[0], path="a\udcff"),)
    ),
    "a size beyond numbers": lambda field: replace(
        field, sources=(replace(field.sources[0], size=2**70),)
    ),
    "warnings of surrogates": lambda field: replace(field, warnings=("a\udcff",)),
    "a warning without end": lambda field: replace(field, warnings=("a" * 10_000_000,)),
    "more unphysical voxels than numbers": lambda field: replace(field, unphysical=2**70),
    "unphysical voxels below 0": lambda field: replace(field, unphysical=-1),
    "a frame of NaN": lambda field: replace(field, frame=np.full((4, 4), np.nan)),
}


@pytest.mark.parametrize("case", FIELDS)
def test_a_field_that_is_none_is_refused(make_pair, case):
    pair = make_pair()
    sound = PixieVerse().read(pair, 0.1)
    adapter = SimpleNamespace(read=lambda *_: FIELDS[case](sound))
    with pytest.raises(InputError, match=THEIRS):
        guarded("slatprep.sources", adapter, "mine", "theirs 1.0").read(pair, 0.1)


def test_a_sound_field_passes(make_pair):
    pair = make_pair()
    field = guarded("slatprep.sources", PixieVerse(), "mine", "theirs 1.0").read(pair, 0.1)
    np.testing.assert_array_equal(field.voxels, PixieVerse().read(pair, 0.1).voxels)


SLATS: dict[str, Callable[[Any], Any]] = {
    "nothing": lambda slat: None,
    "NaN": lambda slat: replace(slat, feats=slat.feats * np.nan),
    "channels": lambda slat: replace(slat, feats=slat.feats[:, :5]),
    "rows": lambda slat: replace(slat, feats=slat.feats[:-1]),
    "out of the grid": lambda slat: replace(slat, coords=slat.coords + np.uint8(100)),
    "another grid": lambda slat: replace(slat, resolution=32),
    "twice": lambda slat: replace(slat, coords=np.zeros_like(slat.coords)),
    "another type": lambda slat: replace(slat, coords=slat.coords.astype(np.int64)),
    "no files": lambda slat: replace(slat, sources=()),
    "warnings of surrogates": lambda slat: replace(slat, warnings=("\udc80",)),
    "a digest of bytes": lambda slat: of_file(slat, sha256=b"0" * 64),
    "a digest of surrogates": lambda slat: of_file(slat, sha256="\udcff" * 64),
    "a role that is none": lambda slat: of_file(slat, role="script"),
    "a source that is none": lambda slat: of_file(slat, source=-1),
    "standardised perhaps": lambda slat: replace(slat, standardised="no"),
    "a grid without end": lambda slat: replace(slat, resolution="x" * 10**6),
}


def of_file(slat: Any, **changes: object) -> Any:
    return replace(slat, sources=(replace(slat.sources[0], **changes),))


@pytest.mark.parametrize("case", SLATS)
def test_latents_that_are_none_are_refused(make_pair, case):
    pair = make_pair()
    sound = read_latents(pair)
    adapter = SimpleNamespace(read=lambda *_: SLATS[case](sound))
    with pytest.raises(InputError, match=THEIRS) as refused:
        guarded("slatprep.latents", adapter, "mine", "theirs 1.0").read("a", "b", "", TRELLIS)
    assert len(str(refused.value).encode()) < 2000


def _raising(*_: object) -> Any:
    raise KeyError("boom")


def _leaving(*_: object) -> Any:
    raise SystemExit(3)


def _half_found(*_: object) -> Iterator[FoundField]:
    yield FoundField("a", "a.npy")
    raise KeyError("boom")


def _closing(*_: object) -> Any:
    raise GeneratorExit


@pytest.mark.parametrize("raising", [_raising, _leaving, _closing, None])
def test_whatever_is_raised_is_theirs(make_pair, raising):
    told = SimpleNamespace(describe=raising, read=raising, find=raising)
    adapter: Any = guarded("slatprep.sources", told, "mine", "theirs 1.0")
    for call in (
        lambda: adapter.describe(None),
        lambda: adapter.read(make_pair(), 0.1),
        lambda: list(adapter.find(None, None)),
        lambda: adapter.patterns,
    ):
        with pytest.raises(InputError, match=THEIRS):
            call()


@pytest.mark.parametrize(
    "held",
    [
        None,
        Holding(properties=(1, 2)),  # type: ignore[arg-type]
        Holding(properties=()),
        Holding(properties=(PROPERTIES[0],) * 2),
        Holding(classes="abc"),  # type: ignore[arg-type]
        Holding(classes=("A\x1b[2J",)),
        Holding(classes=tuple(f"c{k}" for k in range(255))),
    ],
)
def test_what_a_source_cannot_hold_is_refused(held):
    told = SimpleNamespace(describe=lambda _: held)
    with pytest.raises(InputError, match=THEIRS):
        guarded("slatprep.sources", told, "mine", "theirs 1.0").describe(None)  # type: ignore


@pytest.mark.parametrize("found", [_half_found, lambda *_: None, lambda *_: [5]])
def test_what_is_no_field_is_not_found(found):
    adapter: Any = guarded("slatprep.sources", SimpleNamespace(find=found), "mine", "theirs 1.0")
    with pytest.raises(InputError, match=THEIRS):
        list(adapter.find(None, None))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    codes = {
        "torn": "def (",
        "boom": "raise RuntimeError('at import')",
        "leave": "import sys; sys.exit(3)",
        "borrowed": "from slatprep.readers.slat import trellis as made",
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

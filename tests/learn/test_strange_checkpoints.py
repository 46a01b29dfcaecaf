"""Checkpoints from strangers: each is refused in words, within little memory."""

import io
import json
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from support.memory import less_than

from slatprep.errors import InputError
from slatprep.learn.decoder import make_decoder
from slatprep.learn.predict import checkpoint_state, load_checkpoint
from slatprep.normalize import PIXIE_RANGES

MOST_BYTES = 100e6


def shared(depth: int = 9, width: int = 10) -> list[Any]:
    """Return a list of width ** depth leaves that takes no memory: one list holds another."""
    inner: list[Any] = [0.0] * width
    for _ in range(depth - 1):
        inner = [inner] * width
    return inner


def with_contents(state: dict[str, Any], **change: object) -> None:
    state["contents"] = json.dumps(json.loads(state["contents"]) | change)


NONE = r"best\.pt: holds no decoder with its ranges"
CHANGES: dict[str, tuple[Callable[[dict[str, Any]], object], str]] = {
    "ranges that hold themselves": (lambda s: s.update(ranges=shared()), "ranges are not a list"),
    "rows that hold themselves": (lambda s: s.update(ranges=[shared()] * 3), "two numbers each"),
    "a size without end": (lambda s: s.update(size=shared()), "size is list, not a text"),
    "contents without end": (lambda s: s.update(contents=shared()), "contents is list"),
    "a source without end": (lambda s: s.update(ranges_source=shared()), "ranges_source is list"),
    "whole numbers": (lambda s: s.update(ranges=[[0, 1]] * 3), "two numbers each"),
    "ranges beyond floats": (lambda s: s.update(ranges=[[0.0, 1e308]] * 3), "not finite"),
    "ranges beyond float32": (lambda s: s.update(ranges=[[0.0, 300.0]] * 3), "not finite"),
    "one name for two classes": (lambda s: with_contents(s, classes=["a", "a"]), "one name"),
    "too many classes": (
        lambda s: with_contents(s, classes=[f"c{k}" for k in range(300)]),
        "300 classes, not at most 254",
    ),
    "no property": (lambda s: with_contents(s, properties=[]), "0 properties"),
    "whole weights": (
        lambda s: s["model"].update({k: v.to(torch.int8) for k, v in s["model"].items()}),
        "torch.int8, not real numbers",
    ),
    "complex weights": (
        lambda s: s["model"].update({k: v.to(torch.complex64) for k, v in s["model"].items()}),
        "torch.complex64, not real numbers",
    ),
    "weights that are none": (lambda s: s.update(model=shared()), "holds no decoder"),
    "no ranges": (lambda s: s.pop("ranges"), NONE),
    "ranges turned about": (lambda s: s.update(ranges=[[1.0, 0.0]] * 3), NONE),
    "another size": (lambda s: s.update(size="huge"), NONE),
    "ranges without end": (lambda s: s.update(ranges=torch.zeros(1).expand(10**9)), NONE),
    "a weight too few": (lambda s: s["model"].popitem(), NONE),
    "no numbers": (lambda s: s["model"]["regression.weight"].fill_(float("nan")), NONE),
}


def refused(path: Path, said: str) -> None:
    with less_than(MOST_BYTES), pytest.raises(InputError, match=said) as caught:
        load_checkpoint(path)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700


@pytest.mark.parametrize(("change", "said"), CHANGES.values(), ids=CHANGES)
def test_a_checkpoint_is_refused_in_words(change, said, tmp_path):
    state = checkpoint_state(make_decoder("small"), "small", PIXIE_RANGES)
    change(state)
    torch.save(state, tmp_path / "best.pt")
    refused(tmp_path / "best.pt", said)


def test_a_structure_of_millions_of_lists_is_not_unpickled(tmp_path):
    path = tmp_path / "best.pt"
    torch.save({"size": "small"}, path)
    with zipfile.ZipFile(path) as archive:
        members = {info.filename: archive.read(info) for info in archive.infolist()}
    stream = io.BytesIO()
    pickler = pickle.Pickler(stream, protocol=2)
    pickler.fast = True
    pickler.dump([[] for _ in range(1_100_000)])
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, stream.getvalue() if name.endswith("data.pkl") else data)
    refused(path, "its structure takes 1,102,204 bytes")


def test_memory_that_a_checkpoint_would_set_aside_is_not_unpickled(tmp_path):
    torch.save({"size": "small", "extra": bytearray(10)}, tmp_path / "best.pt")
    refused(tmp_path / "best.pt", r"it names '.* bytearray'")
    refused(tmp_path / "other.pt", "does not exist")


def _add(path: Path, name: str, content: bytes, times: int = 1) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        for number in range(times):
            archive.writestr(name.format(number), content)


def test_more_members_than_tensors_are_not_looked_at(tmp_path):
    torch.save({"size": "small"}, tmp_path / "best.pt")
    _add(tmp_path / "best.pt", "best/data/x{}", b"", times=20_000)
    refused(tmp_path / "best.pt", "20,0.. members, and at most 10,000")


def test_members_that_overlap_are_not_read(tmp_path):
    """A directory may name one member again and again, each time with all its bytes."""
    path = tmp_path / "best.pt"
    torch.save({"size": "small", "other": torch.zeros(1000)}, path)
    with zipfile.ZipFile(path) as archive:
        largest = max(archive.infolist(), key=lambda info: info.file_size)
        largest.filename = largest.orig_filename = largest.filename[:-1] + "9"
    with zipfile.ZipFile(path, "a") as archive:
        archive.filelist.append(largest)
        archive.NameToInfo[largest.filename] = largest
        archive.writestr("best/last", b"")
    refused(path, "its members overlap")


def test_a_program_of_torchscript_is_refused_without_a_word_of_torch(tmp_path, recwarn):
    torch.save({"size": "small"}, tmp_path / "best.pt")
    _add(tmp_path / "best.pt", "best/constants.pkl", b"\x80\x02N.")
    refused(tmp_path / "best.pt", "it holds a program of TorchScript")
    assert not recwarn.list


def test_the_largest_decoder_with_its_optimiser_is_no_stranger(tmp_path):
    model = make_decoder("large")
    optimizer = torch.optim.AdamW(model.parameters())
    sum(weight.sum() for weight in model.parameters()).backward()
    optimizer.step()
    state = checkpoint_state(model, "large", PIXIE_RANGES) | {"optimizer": optimizer.state_dict()}
    torch.save(state, tmp_path / "best.pt")
    assert load_checkpoint(tmp_path / "best.pt").size == "large"

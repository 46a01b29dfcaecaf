"""A disk that takes no more, or nothing, is one line and no traceback."""

import errno
import os
from pathlib import Path

import pytest
from click.testing import CliRunner, Result

from slatprep.cli.commands import slatprep
from slatprep.pipeline.dataset import BuildSummary
from slatprep.storage import atomic

NOWHERE = Path("/proc/nobody-may-write-here")


def told(*arguments: object) -> str:
    result: Result = CliRunner().invoke(slatprep, [str(part) for part in arguments])
    assert result.exit_code == 1, result.output
    assert isinstance(result.exception, SystemExit)
    assert "cannot be written to" in result.stderr
    return result.stderr


@pytest.mark.parametrize("command", ["report", "describe"])
def test_a_full_disk(
    mixed_build: BuildSummary, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    def full(path: Path) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(atomic, "flush", full)
    line = told(command, mixed_build.store, "--out", tmp_path / "result")
    assert "No space left on device" in line and "Make room" in line
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_takes_nothing(mixed_build: BuildSummary) -> None:
    told("make-demo", NOWHERE, "--assets", 1)
    told("report", mixed_build.store, "--out", NOWHERE / "r.html")
    told("describe", mixed_build.store, "--out", NOWHERE / "d.json")


def test_a_run_that_has_no_folder(mixed_build: BuildSummary) -> None:
    pytest.importorskip("torch")
    told("train", mixed_build.store, "--out", NOWHERE, "--epochs", 1, "--size", "small")

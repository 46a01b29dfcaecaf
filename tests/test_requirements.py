"""The locked versions are what pyproject.toml allows, and none is forgotten."""

import re
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
EXTRAS = PROJECT["optional-dependencies"]


def declared(*extras: str) -> list[Requirement]:
    """Return what the package and some of its extras ask for, extras of itself followed."""
    found, ahead, seen = list(map(Requirement, PROJECT["dependencies"])), list(extras), set()
    while ahead:
        extra = ahead.pop()
        if extra in seen:
            continue
        seen.add(extra)
        for requirement in map(Requirement, EXTRAS[extra]):
            if requirement.name == "slatprep":
                ahead.extend(requirement.extras)
            else:
                found.append(requirement)
    return found


def locked(name: str) -> dict[str, list[Requirement]]:
    """Return the pins of a file in requirements/ by package: several where markers divide."""
    pins: dict[str, list[Requirement]] = {}
    for line in (ROOT / "requirements" / name).read_text("utf-8").splitlines():
        if line and not line.startswith("#"):
            pin = Requirement(line)
            pins.setdefault(canonicalize_name(pin.name), []).append(pin)
    return pins


@pytest.mark.parametrize(
    ("file", "extras"), [("run.txt", ()), ("test.txt", ("dev",))], ids=["run", "test"]
)
def test_what_is_declared_is_locked_within_its_bounds(file, extras):
    pins = locked(file) | locked("torch.txt")
    for requirement in declared(*extras):
        assert canonicalize_name(requirement.name) in pins, f"{requirement}: run `make lock`"
        here = [
            pin
            for pin in pins[canonicalize_name(requirement.name)]
            if pin.marker is None or pin.marker.evaluate()
        ]
        if requirement.marker is None or requirement.marker.evaluate():
            (pin,) = here
            (version,) = (specifier.version for specifier in pin.specifier)
            assert requirement.specifier.contains(version), f"{requirement}: run `make lock`"


def test_a_run_has_the_versions_that_were_tested():
    tested = locked("test.txt")
    for name, pins in locked("run.txt").items():
        assert list(map(str, pins)) == list(map(str, tested[name]))


def test_nothing_for_graphics_cards_is_locked():
    names = set(locked("test.txt"))
    assert not [name for name in names if re.match("nvidia|cuda|triton|torch$", name)]

"""What installers and hosts of code read: locked versions, workflows, citation."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml
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
        name = canonicalize_name(requirement.name)
        assert name in pins, f"{requirement}: run `make lock`"
        here = [pin for pin in pins[name] if pin.marker is None or pin.marker.evaluate()]
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


WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_citation_is_of_this_version():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == PROJECT["version"]
    assert citation["license"] == PROJECT["license"]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_run_the_targets_there_are(workflow):
    document = yaml.safe_load(workflow.read_text("utf-8"))
    steps = [step for job in document["jobs"].values() for step in job["steps"]]
    runs = [step["run"] for step in steps if "run" in step]
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
    asked = [name for run in runs if run.startswith("make ") for name in run.split()[1:]]
    assert asked and set(asked) <= set(targets)


def test_continuous_integration_covers_the_versions_that_are_stated():
    stated = {one.rpartition(" ")[2] for one in PROJECT["classifiers"] if "Python :: 3." in one}
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text("utf-8"))["jobs"]
    assert stated <= set(jobs["test"]["strategy"]["matrix"]["python"])


def test_issue_forms_have_what_their_reader_wants():
    for form in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"):
        assert {"name", "description", "body"} <= set(yaml.safe_load(form.read_text("utf-8")))

"""What hosts of code read: workflows, citation, source archive."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parents[2]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_citation_is_of_this_version():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    assert citation["version"] == project["version"]
    assert citation["license"] == project["license"]


@pytest.mark.parametrize("workflow", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_run_the_targets_there_are(workflow):
    document = yaml.safe_load(workflow.read_text("utf-8"))
    steps = [step for job in document["jobs"].values() for step in job["steps"]]
    runs = [step["run"] for step in steps if "run" in step]
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text("utf-8"), re.M)
    asked = [name for run in runs if run.startswith("make ") for name in run.split()[1:]]
    assert asked and set(asked) <= set(targets)


def test_continuous_integration_covers_the_versions_that_are_stated():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    stated = {one.rpartition(" ")[2] for one in project["classifiers"] if "Python :: 3." in one}
    jobs = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text("utf-8"))["jobs"]
    assert stated <= set(jobs["test"]["strategy"]["matrix"]["python"])


def test_issue_forms_have_what_their_reader_wants():
    for form in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("[!c]*.yml"):
        document = yaml.safe_load(form.read_text("utf-8"))
        assert {"name", "description", "body"} <= set(document)

"""A build in a process of its own, with a fault in it."""

import subprocess
import sys
from pathlib import Path

from support.faults import environment
from support.synthetic import Dataset

BUILD = """
import json, sys
from pathlib import Path

from slatprep.errors import SlatprepError
from slatprep.parameters import *
from slatprep.pipeline.dataset import build_store

root, out, jobs = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])
{before}
parameters = BuildParameters(
    PixieverseSource(root / "pixieverse"),
    SlatSource(root / "slat"),
    normalize=NormalizeParameters("pixie"),
    store=StoreParameters(voxel_chunk=128, voxel_chunks_per_shard=4, grid_assets_per_shard=2),
)
if __name__ == "__main__":
    try:
        summary = build_store(parameters, out, jobs=jobs)
    except SlatprepError as error:
        sys.exit(f"refused: {{error}}")
    print(json.dumps([summary.statuses, dict(summary.problems)]))
"""


def kill_at(step: str, calls: int = 0) -> str:
    """Return the fault that ends the process when a step is reached after `calls` others."""
    return f"""
if step == {step!r}:
    seen.append(name)
    if len(seen) > {calls}:
        kill_self()
"""


def run(
    script: Path, dataset: Dataset, out: Path, fault: str = "", jobs: int = 1, before: str = ""
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        prepared(script, dataset, out, jobs, before),
        env=environment(script.parent, fault),
        check=False,
        capture_output=True,
        text=True,
    )


def prepared(
    script: Path, dataset: Dataset, out: Path, jobs: int = 1, before: str = ""
) -> list[str]:
    """Write a build and return its command."""
    script.write_text(BUILD.format(before=before))
    return [sys.executable, str(script), str(dataset.root), str(out), str(jobs)]

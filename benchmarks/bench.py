"""Run the measurements that the documentation quotes; write them as JSON and as a page of tables.

    python benchmarks/bench.py --quick
    python benchmarks/bench.py --only build-cost scale --out bench.json --page benchmarks.md

Each measurement runs in a process of its own. If it exceeds its budget of seconds, it is stopped
and the page says so. JSON output becomes a table; printed tables are kept. For each measurement
the page states machine, commit and command. Measurements that do not run this time keep their
place on the page, taken from the existing JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from checkout import ROOT, environment

DEMO = "slatprep make-demo {folder}/demo --assets {assets} --seed 7 --quiet"
MATERIAL = f"{DEMO} --latents material"
STORE = "slatprep build-store --config {folder}/demo/dataset.toml --out {folder}/demo.zarr --quiet"


@dataclass(frozen=True)
class Measurement:
    """One measurement.

    Attributes
    ----------
    name : str
        What ``--only`` calls it.
    title : str
        The question that it answers.
    page : str
        The page that quotes it.
    command : str
        With ``{folder}`` for a temporary folder, ``{assets}`` and ``{size}`` for how large it is.
    full, quick : tuple of (int, int, int)
        ``assets``, ``size`` and the budget [s].
    prepare : tuple of str
        Commands that are run before, and not measured.
    """

    name: str
    title: str
    page: str
    command: str
    full: tuple[int, int, int]
    quick: tuple[int, int, int]
    prepare: tuple[str, ...] = ()


MEASUREMENTS = (
    Measurement(
        "build-cost", "What a build costs beside reading and writing the same bytes",
        "reliability", "python benchmarks/build_cost.py {folder}/demo/dataset.toml --times {size}",
        (24, 68, 900), (8, 1, 120), (DEMO,),
    ),
    Measurement(
        "scale", "How builds and updates grow with the number of assets",
        "reliability", "python benchmarks/scale.py {size}",
        (0, 10_000, 1800), (0, 40, 180),
    ),
    Measurement(
        "scale-large", "The same of assets as large as PixieVerse's",
        "reliability", "python benchmarks/scale.py {size} --like {folder}/demo",
        (24, 10_000, 3600), (6, 20, 180), (DEMO,),
    ),
    Measurement(
        "half-million", "Half a million tiny assets, with alignments given",
        "reliability", "python benchmarks/half_million.py {size} --once --jobs 2",
        (0, 500_000, 14_400), (0, 100, 180),
    ),
    Measurement(
        "kills", "Whether a store survives builds that are killed",
        "reliability", "python benchmarks/soak_kills.py --kills {size} --assets 4",
        (0, 200, 3600), (0, 3, 240),
    ),
    Measurement(
        "damage", "Whether damage to a store is found",
        "reliability", "python benchmarks/damage.py --flips {size} --stores 200",
        (0, 100_000, 3600), (0, 300, 240),
    ),
    Measurement(
        "cluster", "What a Dask cluster costs beside local processes",
        "cluster", "python benchmarks/cluster.py cost {folder}/demo/dataset.toml --workers 2",
        (70, 0, 900), (6, 0, 240), (DEMO,),
    ),
    Measurement(
        "cluster-traffic", "What passes through the command's machine when a cluster writes to S3",
        "cluster", "python benchmarks/cluster.py traffic {folder}/demo/dataset.toml --workers 2",
        (60, 0, 900), (4, 0, 240), (DEMO,),
    ),
    Measurement(
        "empty-tasks", "How many tasks a second one scheduler hands out",
        "cluster", "python benchmarks/cluster.py cost --empty {size} --workers 2",
        (0, 100_000, 300), (0, 2_000, 120),
    ),
    Measurement(
        "remote", "Reading a store on an object store",
        "remote", "python benchmarks/remote.py steps {folder}/demo.zarr --assets {size}",
        (60, 50, 600), (6, 5, 180), (DEMO, STORE),
    ),
    Measurement(
        "published", "What of the published PixieVerse is asked for on the way to a store",
        "pixieverse", "python benchmarks/published.py {folder} --objects {assets}",
        (12, 0, 900), (3, 0, 240),
    ),
    Measurement(
        "remote-ways", "Reading whole assets from an object store, by several ways",
        "remote", "python benchmarks/remote.py ways {folder}/demo.zarr --assets {size}",
        (60, 60, 900), (6, 5, 240), (DEMO, STORE),
    ),
    Measurement(
        "loader", "Loading for training beside npz",
        "training", "python benchmarks/loader.py {folder}/demo.zarr",
        (60, 0, 600), (6, 0, 120), (DEMO, STORE),
    ),
    Measurement(
        "read", "Reading a store beside other formats",
        "reading", "python benchmarks/reading.py {folder}/demo.zarr",
        (60, 0, 600), (6, 0, 180), (DEMO, STORE),
    ),
    Measurement(
        "lookup", "Which way of looking labels up is right most often",
        "design/alignment", "python benchmarks/labels.py lookup {folder}/demo",
        (84, 0, 900), (6, 0, 120), (DEMO,),
    ),
    Measurement(
        "generations", "Whether two generated shapes of one object are aligned and judged right",
        "design/confidence", "python benchmarks/generations.py --objects {size} --seeds 901 902",
        (0, 44, 1800), (0, 5, 240),
    ),
    Measurement(
        "witness", "What latents settle",
        "design/alignment", "python benchmarks/labels.py witness {folder}/demo",
        (96, 0, 1800), (8, 0, 240), (MATERIAL,),
    ),
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="minutes, not hours: does it run?")
    parser.add_argument("--only", nargs="+", choices=[one.name for one in MEASUREMENTS])
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench.json")
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "benchmarks.md")
    parser.add_argument("--list", action="store_true", help="say what there is, and stop")
    arguments = parser.parse_args()
    if arguments.list:
        for one in MEASUREMENTS:
            print(f"{one.name:12} {one.title} (docs/{one.page}.md)")
        return
    found: dict[str, Any] = json.loads(arguments.out.read_text()) if arguments.out.exists() else {}
    for one in MEASUREMENTS:
        if arguments.only and one.name not in arguments.only:
            continue
        found[one.name] = run(one, arguments.quick)
        print(f"{one.name}: {found[one.name]['fault'] or 'done'}", file=sys.stderr, flush=True)
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps(found, indent=2) + "\n")
    arguments.page.write_text("\n".join(page(found)) + "\n")


def run(one: Measurement, quick: bool) -> dict[str, Any]:
    """Run a measurement; return what it printed, and on what."""
    assets, size, budget = one.quick if quick else one.full
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        words = {"folder": folder, "assets": assets, "size": size}
        for command in one.prepare:
            execute(command.format(**words), 1800)
        begin, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        fault, text = "", ""
        try:
            text = execute(one.command.format(**words), budget)
        except subprocess.TimeoutExpired:
            fault = f"stopped after its budget of {budget} s"
        except subprocess.CalledProcessError as error:
            fault = f"failed: {(error.stderr or '').strip().splitlines()[-1:]}"
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "command": one.command.format(**{**words, "folder": "FOLDER"}),
        "prepared by": [command.format(**{**words, "folder": "FOLDER"}) for command in one.prepare],
        "quick": quick,
        "machine": machine(),
        "commit": commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "wall [s]": round(time.perf_counter() - begin, 1),
        "CPU [s]": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
        "load": round(os.getloadavg()[0], 1),
        "fault": fault,
        "result": parsed(text),
    }


def execute(command: str, budget: float) -> str:
    """Run a command of this environment; return what it prints."""
    first, *rest = shlex.split(command)
    program = [sys.executable] if first == "python" else [sys.executable, "-m", "slatprep"]
    told = subprocess.run(
        [*program, *rest], cwd=ROOT, env=environment(), timeout=budget, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    return told.stdout


def parsed(text: str) -> Any:
    """Return what a script printed: a JSON document, the JSON of its lines, or its lines."""
    try:
        return json.loads(text)
    except ValueError:
        pass
    rows = []
    for line in text.splitlines():
        try:
            rows.append(json.loads(line))
        except ValueError:
            continue
    tables = [row for row in rows if isinstance(row, dict)]
    return tables or text.splitlines()


def machine() -> str:
    """Return processor, cores and Python."""
    model = platform.processor() or platform.machine()
    with open("/proc/cpuinfo") as file:  # noqa: PTH123
        names = [line.partition(":")[2].strip() for line in file if line.startswith("model name")]
    cores = len(os.sched_getaffinity(0))
    python = platform.python_version()
    return f"{(names or [model])[0]}, {cores} cores, {platform.system()}, Python {python}"


def commit() -> str:
    """Return the commit that is measured, and whether files differ from it."""

    def git(*words: str) -> str:
        told = subprocess.run(
            ["git", *words], cwd=ROOT, capture_output=True, text=True, check=False
        )
        return told.stdout.strip()

    changed = "" if not git("status", "--porcelain", "--", "slatprep") else ", with changes"
    return f"{git('rev-parse', '--short=12', 'HEAD') or 'unknown'}{changed}"


def page(found: dict[str, Any]) -> Iterator[str]:
    """Yield the lines of the page."""
    yield "# Benchmarks"
    yield ""
    yield "`make bench` runs these and writes this page; `make bench BENCH=--quick` tries each on"
    yield "little data. What the numbers mean is told on the page that each names."
    for one in MEASUREMENTS:
        run_of = found.get(one.name)
        if run_of is None:
            continue
        yield from ("", f"## {one.title}", "", f"Quoted in [{one.page}]({one.page}.md).", "")
        yield f"- Command: `{run_of['command']}`" + "".join(
            f", after `{command}`" for command in run_of["prepared by"]
        )
        yield f"- Commit: {run_of['commit']}, {run_of['date']}"
        yield f"- Machine: {run_of['machine']}; load before and beside it {run_of['load']}"
        yield f"- It took {run_of['wall [s]']} s, {run_of['CPU [s]']} s of CPU" + (
            "; a quick run on little data" if run_of["quick"] else ""
        )
        yield ""
        if run_of["fault"]:
            yield f"It {run_of['fault']}."
            continue
        yield from shown(run_of["result"])


def shown(result: Any) -> Iterator[str]:
    """Yield a result as Markdown: tables of what was JSON, all else as it was printed.

    Of several rows, each gets a line with the figures that it has: no cell is empty, and the table
    is as wide as a page.
    """
    if isinstance(result, dict):
        yield from ("| figure | value |", "| --- | --- |")
        yield from (f"| {name} | {cell(value)} |" for name, value in result.items())
        return
    if isinstance(result, list) and result and isinstance(result[0], dict):
        (title, *_), *_ = result
        yield from (f"| {title} | figures |", "| --- | --- |")
        for row in result:
            figures = (f"{name} {cell(row[name])}" for name in row if name != title)
            yield f"| {cell(row[title])} | {'; '.join(figures)} |"
        return
    yield from ("```text", *(str(line).rstrip() for line in result or []), "```")


def cell(value: Any) -> str:
    """Return a value for a table: the items of lists and objects, none as a dash."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {cell(one)}" for name, one in value.items())
    if isinstance(value, list):
        return ("; " if value and isinstance(value[0], dict) else ", ").join(map(cell, value))
    return "-" if value is None else str(value)


if __name__ == "__main__":
    main()

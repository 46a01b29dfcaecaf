"""Change one operator or number at a time and see whether the tests notice.

    python tools/mutants.py --budget 1500 --seed 0          # what `make mutants` does
    python tools/mutants.py --budget 300 judge sample       # some modules alone

Each change (a mutant) is made in a copy of the tree and given to the tests of
its module. Processes are forked from one that has the libraries loaded, which
takes most of the time of a test run here. Mutants are taken in turn from all
modules, in an order drawn by the seed, until the budget [s of wall clock] is
spent. A mutant is caught if a test fails, or runs ten times as long as without
it. Those that survive are printed: each is a test that is missing, or a change
that makes no difference.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import copy
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]

TESTS = {
    "align/quality": ["align/test_quality.py"],
    "align/starts": ["align/test_starts.py", "align/test_quality.py"],
    "align/consensus": ["align/test_consensus.py"],
    "align/surface": ["align/test_surface.py"],
    "align/settle": ["align/test_settle.py"],
    "align/deformation": ["align/test_deformation.py"],
    "sample": ["test_sample.py"],
    "judge/ambiguity": ["judge/test_ambiguity.py"],
    "judge/evidence": ["judge/test_confidence.py", "judge/test_ambiguity.py"],
    "judge/confidence": ["judge/test_confidence.py"],
    "judge/verdict": ["judge/test_confidence.py", "align/test_quality.py"],
    "judge/witness": ["judge/test_witness.py"],
    "normalize": ["test_normalize.py"],
    "geometry/frames": ["geometry"],
    "geometry/voxels": ["geometry", "test_sample.py", "align/test_surface.py"],
    "geometry/nearest": ["geometry/test_nearest.py"],
    "geometry/fill": ["geometry/test_fill.py"],
    "geometry/distance": ["geometry/test_distance.py"],
    "store/reader": [
        "store/test_reader.py",
        "store/test_contract.py",
        "store/test_shard_reader.py",
    ],
    "store/assets": ["store/test_reader.py", "store/test_contract.py"],
    "store/attributes": ["store/test_reader.py", "store/test_contract.py"],
    "store/shard_reader": ["store/test_shard_reader.py", "store/test_reader.py"],
    "store/shard_writer": ["store/test_shard_writer.py"],
    "store/writer": ["store/test_writer.py", "store/test_layout.py", "pipeline/test_update.py"],
}
"""Modules of the package, and the tests that are to catch what is wrong in them."""

LIBRARIES = ("numpy", "scipy.spatial", "scipy.ndimage", "numba", "h5py", "zarr", "pydantic",
             "orjson", "click", "rich", "hypothesis", "pytest")  # fmt: skip

SWAPS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Add, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.LShift: ast.RShift, ast.RShift: ast.LShift,
}  # fmt: skip


@dataclass(frozen=True)
class Mutant:
    """One change: where it is, and the module's text with it."""

    module: str
    line: int
    change: str
    text: str


def main() -> None:
    """Read the command line, run, and print the score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=", ".join(TESTS))
    parser.add_argument("--budget", type=float, default=1500.0, help="seconds of wall clock")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for unknown in sorted(set(arguments.modules) - set(TESTS)):
        parser.error(f"{unknown}: is none of the modules {', '.join(TESTS)}")
    end = time.monotonic() + arguments.budget
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # they take longer than most tests
    for library in LIBRARIES:
        __import__(library)
    folder = Path(tempfile.mkdtemp(prefix="mutants-"))
    try:
        for name in ("slatprep", "tests", "pyproject.toml"):
            whole = ROOT / name
            (shutil.copytree if whole.is_dir() else shutil.copy)(whole, folder / name)
        compileall.compile_dir(folder / "slatprep", quiet=1)
        modules = {name: TESTS[name] for name in arguments.modules or TESTS}
        score = measure(folder, modules, arguments.seed, end)
    finally:
        shutil.rmtree(folder)
    print(json.dumps(score, indent=1))


def measure(
    folder: Path, modules: dict[str, list[str]], seed: int, end: float
) -> dict[str, dict[str, int]]:
    """Return by module how many mutants there are, were tried and were caught."""
    order, score, limits = random.Random(seed), {}, {}
    queues: dict[str, list[Mutant]] = {}
    for module, tests in modules.items():
        begin, whole = time.monotonic(), tuple(tests)
        if whole not in limits:
            if not passes(folder, tests, limit=1200.0):
                raise SystemExit(f"{module}: its tests fail without any mutant; mend them first")
            limits[whole] = 10.0 * (time.monotonic() - begin) + 10.0
        queues[module] = list(mutants_of(folder, module))
        order.shuffle(queues[module])
        score[module] = {"mutants": len(queues[module]), "tried": 0, "caught": 0}
    while any(queues.values()) and time.monotonic() < end:
        for module in [name for name, queue in queues.items() if queue]:
            mutant, place = queues[module].pop(), folder / "slatprep" / f"{module}.py"
            original = place.read_text("utf-8")
            place.write_text(mutant.text, "utf-8")
            survived = passes(folder, modules[module], limits[tuple(modules[module])])
            place.write_text(original, "utf-8")
            score[module]["tried"] += 1
            score[module]["caught"] += not survived
            if survived:
                print(f"slatprep/{module}.py:{mutant.line}: {mutant.change}", flush=True)
            if time.monotonic() > end:
                break
    total = {
        key: sum(part[key] for part in score.values()) for key in ("mutants", "tried", "caught")
    }
    return {**score, "all": total}


def mutants_of(folder: Path, module: str) -> Iterator[Mutant]:
    """Yield every change to a module; not to annotations, decorators and what errors say."""
    tree = ast.parse((folder / "slatprep" / f"{module}.py").read_text("utf-8"))
    for node in told_apart(tree):
        for changed in changes_of(node):
            before = ast.unparse(node)
            kept = dict(node.__dict__)
            node.__dict__.update(changed.__dict__)
            yield Mutant(module, node.lineno, f"{before} -> {ast.unparse(node)}", ast.unparse(tree))
            node.__dict__.clear()
            node.__dict__.update(kept)


def told_apart(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the expressions below a node whose change a test should notice."""
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list") or isinstance(node, ast.JoinedStr):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST) and not (
                isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING"
            ):
                yield child
                yield from told_apart(child)


def changes_of(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the node with its operator swapped, or its number one larger."""
    changed = copy.copy(node)
    if isinstance(node, ast.Compare) and len(node.ops) == 1 and type(node.ops[0]) in SWAPS:
        changed.ops = [SWAPS[type(node.ops[0])]()]  # type: ignore[attr-defined]
    elif isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in SWAPS:
        changed.op = SWAPS[type(node.op)]()  # type: ignore[attr-defined]
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        changed.value = not node.value  # type: ignore[attr-defined]
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        changed.value = node.value + 1  # type: ignore[attr-defined]
    else:
        return
    yield changed


def passes(folder: Path, tests: list[str], limit: float) -> bool:
    """Return whether tests pass in the copy; run in a process forked from this one."""
    sys.stdout.flush()
    child = os.fork()
    if not child:
        os.setsid()
        run_tests(folder, tests)
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def run_tests(folder: Path, tests: list[str]) -> None:
    """Run tests on the copy and end this process with pytest's exit code."""
    import pytest

    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    os.chdir(folder)
    sys.dont_write_bytecode = True  # its key has whole seconds: two mutants might share one
    sys.path.insert(0, str(folder))
    os.environ.update(PYTHONPATH=str(folder), PYTHONDONTWRITEBYTECODE="1")
    options = ["-x", "-q", "-p", "no:cacheprovider"]
    os._exit(int(pytest.main([*options, *(f"tests/{test}" for test in tests)])))


if __name__ == "__main__":
    main()

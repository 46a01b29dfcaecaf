"""Change one operator or number at a time and check whether the tests notice.

    python tools/mutants.py --budget 1500 --seed 0          # what `make mutants` does
    python tools/mutants.py --budget 300 normalize sample   # some modules alone

The tests of a module run on each change (a mutant). They are collected and run
once. Each mutant is then put into the functions of a process forked from this
one, so that it costs only the time of its tests. A module that Numba compiles is
instead changed in a copy of the tree, and imported again for each mutant. Only
such modules have their constants changed. Mutants are drawn by the seed; each
module gets the same share of the budget [s of wall clock]. A mutant is caught if
a test fails, or runs ten times as long as without it. Surviving mutants are
printed: each shows a missing test, or a change that makes no difference.
"""

from __future__ import annotations

import argparse
import ast
import compileall
import copy
import enum
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import types
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

TESTS = {
    "align/quality": ["align/test_surface.py"],
    "align/starts": ["align/test_surface.py", "align/test_field.py"],
    "align/consensus": ["align/test_settle.py"],
    "align/surface": ["align/test_surface.py"],
    "align/settle": ["align/test_settle.py"],
    "geometry/deformation": ["geometry/test_frames.py"],
    "align/stretch": ["align/test_deform.py"],
    "align/residuals": ["align/test_deform.py", "judge/test_evidence.py"],
    "align/pair": ["align/test_pair.py", "align/test_settle.py", "align/test_deform.py"],
    "sample": ["test_sample.py"],
    "judge/ambiguity": ["judge/test_verdict.py"],
    "judge/evidence": ["judge/test_evidence.py"],
    "judge/confidence": ["judge/test_evidence.py", "judge/test_verdict.py"],
    "judge/verdict": ["judge/test_verdict.py", "align/test_surface.py"],
    "judge/witness": ["judge/test_witness.py"],
    "normalize": ["test_normalize.py"],
    "geometry/frames": ["geometry"],
    "geometry/voxels": ["geometry/test_frames.py"],
    "geometry/nearest": ["geometry/test_nearest.py"],
    "geometry/fill": ["geometry/test_nearest.py"],
    "geometry/distance": ["geometry/test_nearest.py"],
    "store/reader": ["store/test_assets_of_store.py"],
    "store/assets": ["store/test_assets_of_store.py"],
    "store/attributes": ["store/test_record.py"],
    "store/layout": ["store/test_runs.py"],
    "store/shard_reader": ["store/test_row_reader.py", "store/test_writer.py"],
    "store/shard_writer": ["store/test_writer.py"],
    "store/runs": ["store/test_runs.py"],
    "store/writer": ["store/test_runs.py", "store/test_writer.py"],
}
"""Modules of the package, and the tests that must catch errors in them."""

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
    """One change: its place, and the text of the changed module."""

    module: str
    line: int
    change: str
    text: str


def main() -> None:
    """Read the command line, test the mutants, and print the score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", metavar="MODULE", help=", ".join(TESTS))
    parser.add_argument("--budget", type=float, default=1500.0, help="seconds of wall clock")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    for unknown in sorted(set(arguments.modules) - set(TESTS)):
        parser.error(f"{unknown}: is none of the modules {', '.join(TESTS)}")
    end = time.monotonic() + arguments.budget
    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"  # loading takes longer than most tests
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
    """Return by module the number of mutants that exist, were tried and were caught."""
    order, score = random.Random(seed), {}
    for left, (module, tests) in zip(range(len(modules), 0, -1), modules.items(), strict=True):
        text = (folder / "slatprep" / f"{module}.py").read_text("utf-8")
        compiled, inside = "@kernel" in text, lines_in_functions(text)
        queue = [one for one in mutants_of(folder, module) if compiled or one.line in inside]
        order.shuffle(queue)
        trial = imported_anew if compiled else collected_once
        until = time.monotonic() + (end - time.monotonic()) / left
        survived = list(trial(folder, module, tests, queue, until))
        for mutant, survives in zip(queue, survived, strict=False):
            if survives:
                print(f"slatprep/{module}.py:{mutant.line}: {mutant.change}", flush=True)
        caught = survived.count(False)
        score[module] = {"mutants": len(queue), "tried": len(survived), "caught": caught}
    total = {
        key: sum(part[key] for part in score.values()) for key in ("mutants", "tried", "caught")
    }
    return {**score, "all": total}


def lines_in_functions(text: str) -> set[int]:
    """Return the lines of a module that are part of a function.

    Other lines hold constants. A running process cannot change a constant that other modules have
    imported by name.
    """
    functions = (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef))
    return {line for n in functions for line in range(n.lineno, (n.end_lineno or n.lineno) + 1)}


def imported_anew(
    folder: Path, module: str, tests: list[str], queue: list[Mutant], until: float
) -> Iterator[bool]:
    """Yield whether each mutant survives if it is written into the copy of the tree."""
    begin = time.monotonic()
    if not passes(lambda: run_tests(folder, tests), limit=1200.0):
        raise SystemExit(f"{module}: its tests fail without any mutant; mend them first")
    limit = 10.0 * (time.monotonic() - begin) + 10.0
    place = folder / "slatprep" / f"{module}.py"
    original = place.read_text("utf-8")
    for mutant in queue:
        if time.monotonic() > until:
            break
        place.write_text(mutant.text, "utf-8")
        yield passes(lambda: run_tests(folder, tests), limit)
        place.write_text(original, "utf-8")


def collected_once(
    folder: Path, module: str, tests: list[str], queue: list[Mutant], until: float
) -> list[bool]:
    """Return whether each mutant survives if it is put into a process that has run its tests."""
    found = folder / "survived.json"
    found.unlink(missing_ok=True)
    trials = Trials(f"slatprep.{module.replace('/', '.')}", queue, until, found)
    limit = 1200.0 + 2.0 * max(until - time.monotonic(), 0.0)
    if not passes(lambda: run_tests(folder, tests, [trials]), limit) or not found.exists():
        raise SystemExit(f"{module}: its tests fail without any mutant; mend them first")
    survived: list[bool] = json.loads(found.read_text("utf-8"))
    return survived


class Trials:
    """A pytest plugin that runs the tests, and then forks a process for each mutant."""

    def __init__(self, module: str, queue: list[Mutant], until: float, found: Path) -> None:
        self.module, self.queue, self.until, self.found = module, queue, until, found

    def pytest_runtestloop(self, session: Any) -> bool:
        """Run the tests unchanged, which sets up shared fixtures, and then with each mutant."""
        begin = time.monotonic()
        if not all_pass(session.items):
            session.testsfailed = 1
            return True
        limit = 10.0 * (time.monotonic() - begin) + 10.0
        text = Path(str(sys.modules[self.module].__file__)).read_text("utf-8")
        same = Mutant(self.module, 0, "nothing is changed", text)
        if not passes(lambda: self.trial(same, session.items), limit):
            session.testsfailed = 1  # The tests fail unchanged, so catching a mutant means nothing.
            return True
        survived = []
        for mutant in self.queue:
            if time.monotonic() > self.until:
                break
            survived.append(passes(lambda one=mutant: self.trial(one, session.items), limit))
        self.found.write_text(json.dumps(survived), "utf-8")
        return True

    def trial(self, mutant: Mutant, items: list[Any]) -> None:
        """Put a mutant into the module, run the tests and end the process."""
        module = sys.modules[self.module]
        changed = {"__name__": self.module, "__file__": module.__file__,
                   "__package__": module.__package__}  # fmt: skip
        try:
            exec(compile(mutant.text, str(module.__file__), "exec"), changed)
            put_into(vars(module), changed, module)
            os._exit(not all_pass(items))
        except BaseException:
            os._exit(1)


def all_pass(items: list[Any]) -> bool:
    """Run collected tests, also if they ran before; stop at the first failure."""
    from _pytest.runner import runtestprotocol

    for item, following in zip(items, [*items[1:], items[0]], strict=True):
        item._initrequest()
        # An item that follows keeps the session's fixtures for the next process.
        if any(report.failed for report in runtestprotocol(item, nextitem=following, log=False)):
            return False
    return True


def put_into(there: Any, changed: Any, owner: object) -> None:
    """Replace the code of functions in place, for all their users, and the values of constants."""
    for name, new in dict(changed).items():
        old = there.get(name)
        if old is new:
            continue  # imported by the module
        for inner in ("__func__", "__wrapped__", "fget", "func"):
            if hasattr(new, inner) and hasattr(old, inner):
                if hasattr(old, "cache_clear"):
                    old.cache_clear()
                old, new = getattr(old, inner), getattr(new, inner)
        if isinstance(old, types.FunctionType) and isinstance(new, types.FunctionType):
            if old.__module__ == new.__module__:
                old.__code__, old.__defaults__ = new.__code__, new.__defaults__
                old.__kwdefaults__ = new.__kwdefaults__
        elif isinstance(old, type) and isinstance(new, type):
            if old.__module__ == new.__module__ and not issubclass(old, enum.Enum):
                put_into(vars(old), vars(new), old)
        elif isinstance(new, int | float | tuple | frozenset) and not name.startswith("__"):
            setattr(owner, name, new)


def mutants_of(folder: Path, module: str) -> Iterator[Mutant]:
    """Yield every change to a module, except in annotations, decorators and error messages."""
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


def passes(run: Callable[[], None], limit: float) -> bool:
    """Return whether a forked process that calls `run`, which must end it, exits with 0."""
    sys.stdout.flush()
    child = os.fork()
    if not child:
        os.setsid()
        run()
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status) == 0
        time.sleep(0.05)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return False


def run_tests(folder: Path, tests: list[str], plugins: list[object] | None = None) -> None:
    """Run tests on the copy of the tree and end this process with pytest's exit code."""
    import pytest

    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    os.chdir(folder)
    sys.dont_write_bytecode = True  # its key has whole seconds, so two mutants could share it
    sys.path.insert(0, str(folder))
    os.environ.update(PYTHONPATH=str(folder), PYTHONDONTWRITEBYTECODE="1")
    options = ["-x", "-q", "-p", "no:cacheprovider"]
    os._exit(int(pytest.main([*options, *(f"tests/{test}" for test in tests)], plugins)))


if __name__ == "__main__":
    main()

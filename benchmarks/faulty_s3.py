"""Use stores on an object store that gives faulty answers, and check that no harm comes of it.

    python benchmarks/faulty_s3.py --minutes 30 --seed 1
    python benchmarks/faulty_s3.py --runs 40

moto's S3 answers on loopback, behind a proxy that makes a share of the answers faulty, drawn by the
seed: server errors (500, 503 SlowDown, 403, 404); connections reset before or after the server
did its work; requests that arrive twice; bodies that are cut, shorter, longer, of another object or
have a flipped bit; delays; outdated listings and pointers; and 409 or 412 for a conditional write.

Each run builds a store on S3 or updates it, builds from sources on S3, or verifies, reads,
copies, exports or reports a store. It must give the same result as without faults, byte for byte,
or end in an error in words. After an error the old store must still exist, and a message must not
say that nothing changed if something did. After every refused update the same command runs without
faults, and must succeed. Every harm is printed, and makes the exit code 1.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import checkout
import fsspec
from click.testing import CliRunner
from support import object_store
from support.faulty_proxy import KINDS, Faults, faulty
from support.remote import Dataset, current, put
from support.trees import tree

from slatprep.cli.commands import slatprep
from slatprep.errors import SlatprepError
from slatprep.parameters import BuildParameters, PixieverseSource, SlatSource
from slatprep.pipeline.dataset import build_store
from slatprep.storage.place import place_of
from slatprep.store import Store, open_store

SECONDS_A_RUN = 300
BUCKET, URL = "bench", "s3://bench/stores/s.zarr"
CHANCES = (0.01, 0.03, 0.1, 0.3)

SOUND = tuple(kind for kind in KINDS if kind != "flipped")
"""What may happen to sources: nobody but its maker knows that a bit of a source is another."""

READERS: dict[str, tuple[str, ...]] = {
    "verify": (URL,),
    "info": (URL, "--json"),
    "list": (URL, "--json"),
    "describe": (URL,),
    "subset": (URL, "--asset", "a", "--out", "{out}/s.zarr"),
    "export": (URL, "--format", "npz", "--out", "{out}/e"),
    "report": (URL, "--out", "{out}/report.html"),
}


@dataclass
class Bench:
    """A server, the proxy before it, an old and a new dataset and what they give."""

    folder: Path
    faults: Faults
    s3: Any
    chance: random.Random
    only: tuple[str, ...] = ()
    told: Counter[str] = field(default_factory=Counter)
    harm: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.s3.mkdir(BUCKET)
        self.old, self.new = Dataset(self.folder / "old"), Dataset(self.folder / "new")
        for seed, object_id in enumerate("abc"):
            self.new.add(object_id, seed)
            if object_id != "c":
                self.old.add(object_id, seed)
        for dataset in (self.old, self.new):
            build_store(dataset.parameters("pixie"), dataset.root / "s.zarr")
        self.old_tree, self.new_tree = (tree(d.root / "s.zarr") for d in (self.old, self.new))
        put(self.old.root / "s.zarr", URL)
        self.s3.put(f"{self.new.root}/", f"{BUCKET}/data/", recursive=True)
        self.out = self.folder / "out"
        self.out.mkdir()
        self.expected: dict[str, Any] = {}

    def run(self, number: int) -> None:
        """Do one thing under faults, and look at what came of it."""
        operation = self.chance.choice(list(OPERATIONS))
        if operation in READERS and operation not in self.expected:
            self.expected[operation] = self._read_by(operation)
        few = self.chance.choice((1, 2, len(KINDS)))
        some = self.only or self.chance.sample(KINDS, few)
        self.faults.kinds = tuple(k for k in some if operation != "sources" or k in SOUND)
        self.faults.seed = f"{self.chance.random()}"
        self.faults.lasting = self.chance.random() < 0.2
        chance = self.chance.choice(CHANCES)
        how = "lasting" if self.faults.lasting else "passing"
        what = f"run {number}: {operation}, {chance:.0%} of requests, {how}, {', '.join(some)}"
        before, noted = sum(self.faults.told.values()), len(self.harm)
        signal.alarm(SECONDS_A_RUN)
        self.faults.chance = chance
        try:
            outcome = OPERATIONS[operation](self)
        except SlatprepError as error:
            outcome = f"refused: {error}"
        except TimeoutError:
            outcome = "hangs"
            self.harm.append(outcome)
        except Exception:  # What must not happen is what is looked for.
            outcome = "ends in a traceback"
            self.harm.append(f"{outcome}\n{traceback.format_exc(limit=-8)}")
        finally:
            self.faults.chance = 0.0
            signal.alarm(0)
        if not sum(self.faults.told.values()) > before:
            outcome = f"nothing happened: {outcome}"
        self._look_after(operation, outcome)
        self.told[f"{operation}: {outcome.partition(':')[0]}"] += 1
        self.harm[noted:] = [f"{what}: {harm}" for harm in self.harm[noted:]]

    def build(self, sources: BuildParameters, out: Any, expected: Callable[[], Any]) -> str:
        """Build; the store must be the one expected."""
        build_store(sources, out, strict=True)
        self.faults.chance = 0.0
        return self.same(expected(), self.new_tree, "what was built")

    def same(self, found: Any, expected: Any, what: str) -> str:
        """Note it as harm where two things differ that must not."""
        if found == expected:
            return "as without faults"
        self.harm.append(
            f"{what} is not what it is without faults: {_differences(found, expected)}"
        )
        return "differs"

    def _read_by(self, name: str) -> tuple[str, dict[str, str]]:
        line = [part.format(out=self.out) for part in READERS[name]]
        result = CliRunner().invoke(slatprep, [name, *line])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        made = tree(self.out)
        shutil.rmtree(self.out)
        self.out.mkdir()
        if result.exit_code:
            left = [f for f in made if not f.startswith((".", "s.manifests"))]
            if left:
                self.harm.append(f"{name} was refused and left {left[:5]}")
            raise SlatprepError(result.stderr or result.stdout)
        # What is written counts where there is any: a summary, as records do, tells of times.
        stores = {file: digest for file, digest in made.items() if "s.manifests/" not in file}
        return "" if stores else result.stdout, stores

    def read_by(self, name: str) -> str:
        """Run a command; what it prints and writes must be what it is without faults."""
        return self.same(self._read_by(name), self.expected[name], f"what {name} gives")

    def _look_after(self, operation: str, outcome: str) -> None:
        """See that the store is the old or the new one, and put the old one back."""
        now = self.stored()
        untouched = None if operation == "first" else self.old_tree
        if "refused" in outcome and now != untouched:
            self._moved(outcome, now)
        if operation in ("update", "first"):
            if "refused" in outcome:
                build_store(self.new.parameters("pixie"), URL, strict=True)
                self.same(self.stored(), self.new_tree, "what the next build gives")
            self.s3.rm(URL, recursive=True)
            put(self.old.root / "s.zarr", URL)
        elif now != self.old_tree:
            self.harm.append(f"{operation} changed the store")
        shutil.rmtree(self.out)
        self.out.mkdir()
        if self.chance.random() < 0.3:
            shutil.rmtree(os.environ["SLATPREP_CACHE"], ignore_errors=True)

    def _moved(self, outcome: str, now: Any) -> None:
        if now != self.new_tree:
            self.harm.append(f"the store that was there is spoiled: {outcome}")
        elif "nothing was" in outcome:
            self.harm.append(f"the new store is there, and the message denies it: {outcome}")
        else:
            self.told["refused, with the new store in sight and not denied"] += 1

    def stored(self) -> dict[str, str] | None:
        """Return what is in sight at the URL, past the proxy."""
        return current(self.s3, URL) if self.s3.exists(f"{URL}/current.json") else None


def _update(bench: Bench) -> str:
    return bench.build(bench.new.parameters("pixie"), URL, bench.stored)


def _first(bench: Bench) -> str:
    bench.s3.rm(URL, recursive=True)
    return _update(bench)


def _sources(bench: Bench) -> str:
    place = place_of(f"s3://{BUCKET}/data")
    parameters = replace(
        bench.new.parameters("pixie"),
        pixieverse=PixieverseSource(place / "pixieverse"),
        slat=SlatSource(place / "slat"),
    )
    out = bench.out / "s.zarr"
    if bench.chance.random() < 0.5:
        shutil.copytree(bench.old.root / "s.zarr", out)
    try:
        return bench.build(parameters, out, lambda: tree(out))
    except SlatprepError:
        if out.exists() and tree(out) != bench.old_tree:
            bench.harm.append("the local store that was there is spoiled")
        raise


def _read(bench: Bench) -> str:
    local = open_store(bench.old.root / "s.zarr")
    there = open_store(URL)
    return bench.same(_values(there), _values(local), "what is read")


def _copy(bench: Bench) -> str:
    shutil.rmtree(os.environ["SLATPREP_CACHE"], ignore_errors=True)
    copy = open_store(URL, copy=True)
    found = tree(Path(str(copy.path)))
    return bench.same(found, bench.old_tree, "the copy")


def _values(store: Store) -> list[Any]:
    return [
        (asset_id, [(name, values.tobytes()) for name, values in store.read(row).items()])
        for row, asset_id in enumerate(store.ids)
    ]


OPERATIONS: dict[str, Callable[[Bench], str]] = {
    "update": _update,
    "first": _first,
    "sources": _sources,
    "read": _read,
    "copy": _copy,
    **{name: lambda bench, name=name: bench.read_by(name) for name in READERS},
}


def _differences(found: Any, expected: Any) -> str:
    if isinstance(found, dict) and isinstance(expected, dict):
        names = {*found, *expected}
        return ", ".join(sorted(n for n in names if found.get(n) != expected.get(n))[:5])
    return f"{str(found)[:300]} for {str(expected)[:300]}"


@contextmanager
def bench_of(seed: int, only: tuple[str, ...] = ()) -> Iterator[Bench]:
    """Start server and proxy, and make what is asked of them."""
    faults = Faults()
    with (
        tempfile.TemporaryDirectory(prefix="faulty-s3-") as folder,
        object_store.running() as server,
        faulty(server, faults) as proxy,
    ):
        # Few attempts, or hardly any error of a request is ever seen.
        signal.signal(signal.SIGALRM, _time_is_up)
        os.environ |= {
            **object_store.environment(proxy),
            "AWS_MAX_ATTEMPTS": "2",
            "SLATPREP_CACHE": f"{folder}/cache",
        }
        direct = fsspec.filesystem("s3", endpoint_url=server, use_listings_cache=False)
        yield Bench(Path(folder, "work"), faults, direct, random.Random(seed), only)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after these")
    parser.add_argument("--runs", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=KINDS, help="only these faults")
    given = parser.parse_args()
    begin = time.monotonic()
    runs = 0
    with bench_of(given.seed, tuple(given.kind or ())) as bench, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of older versions that could not be removed
        while runs < given.runs and time.monotonic() < begin + 60 * given.minutes:
            bench.run(runs)
            runs += 1
    for harm in bench.harm:
        print(harm, file=sys.stderr)
    told = {
        "runs": runs,
        "faults": sum(bench.faults.told.values()),
        "harm": len(bench.harm),
        **dict(sorted(bench.told.items())),
        "faults by kind": dict(sorted(bench.faults.told.items())),
        "seconds": round(time.monotonic() - begin, 1),
    }
    print(json.dumps(told, indent=2))
    sys.exit(bool(bench.harm))


def _time_is_up(*_: object) -> None:
    raise TimeoutError


assert checkout.ROOT  # Importing it made the tests' data known.

if __name__ == "__main__":
    main()

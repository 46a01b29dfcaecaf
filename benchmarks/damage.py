"""Damage a store, bit by bit and more severely, and check that no harm comes of it.

    python benchmarks/damage.py --minutes 30 --seed 1
    python benchmarks/damage.py --flips 100000 --stores 5000

Flips: one bit changes in one file of a store or of the records beside it. The checks of
`slatprep verify` must find each flip, or the next build must repair it, or it must have no
meaning: white space in JSON, or when, where and how long a build ran. A flip in `sources.seen`
only costs the next build some hashing. For some of the found flips, all of `verify_store` and the
next build run: the store must then equal the original, byte for byte, or be refused in words.

Stores: a file of a store is cut, emptied, removed, exchanged or overwritten, or an entry of its
JSON is replaced by a hostile value; then a command that reads stores runs. It must end with one of
its exit codes, not with a traceback. Every harm is printed, and makes the exit code 1.
"""

from __future__ import annotations

import argparse
import json
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
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import checkout
import numpy as np
from click.testing import CliRunner
from support.synthetic import Dataset, make_asset
from support.trees import tree

from slatprep.cli.commands import slatprep
from slatprep.errors import SlatprepError, StoreError
from slatprep.inspect.verify import verify_store
from slatprep.inspect.verify.manifests import manifest_findings
from slatprep.pipeline import seen
from slatprep.pipeline.dataset import build_store
from slatprep.storage.arrays import ArrayFile
from slatprep.storage.files import local_files
from slatprep.store import open_store
from slatprep.store.integrity import file_findings, metadata_findings

SECONDS_A_COMMAND = 120
WHOLE_EVERY = 400
"""Flips of which one is verified whole, and built over."""

SEEN_EVERY = 50
"""Flips of which one, if in `sources.seen`, is built over although that file is not believed."""

UNSAID = ("created", "duration_s", "platform", "reason", "traceback")
"""Entries of records that tell of a run and not of its result."""

HOSTILE = (
    None, True, -1, 0, 2**63, 1e308, "", "x", "../../x", "\ud800", [], {}, [[]], [1] * 1000,
    {"name": "pickle"}, {"id": "pickle"}, "<script>", [-1, 3], [2**40, 3],
)  # fmt: skip


@dataclass
class Bench:
    """A sound store with its records, and what was done to it."""

    dataset: Dataset
    store: Path
    chance: random.Random
    until: float
    told: Counter[str] = field(default_factory=Counter)
    harm: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.manifests = self.store.with_suffix(".manifests")
        self.build()
        self.sound = tree(self.store)
        self.beside = self.store.with_name("beside")
        (self.beside / "predictions").mkdir(parents=True)
        np.save(self.beside / "p.npy", np.zeros((9, 3), np.float32))
        for asset in open_store(self.store):
            file = self.beside / "predictions" / f"{asset.asset_id}.npz"
            np.savez(file, properties=np.nan_to_num(asset.properties))
        self.files = [self.store / name for name in sorted(local_files(self.store))]
        self.files += sorted(self.manifests.iterdir())
        self.opened = open_store(self.store)
        self._kinds: dict[str, list[Path]] = {}
        for file in self.files:
            kind = file.relative_to(self.store.parent).parts[1]
            self._kinds.setdefault("metadata" if file.name == "zarr.json" else kind, []).append(
                file
            )

    def any_file(self) -> Path:
        """Return a file; the few of a kind come as often as the many of another."""
        return self.chance.choice(self._kinds[self.chance.choice(list(self._kinds))])

    def build(self) -> None:
        """Bring the store up to date."""
        build_store(self.dataset.parameters("pixie"), self.store)

    def name(self, file: Path) -> str:
        """Return what a file is called in what is printed."""
        return file.relative_to(self.store.parent).as_posix()

    def time_left(self) -> bool:
        """Whether there is any."""
        return time.monotonic() < self.until

    @contextmanager
    def changed(self, file: Path) -> Iterator[bytes]:
        """Yield a file's content, and put it back at the end."""
        content = file.read_bytes()
        try:
            yield content
        finally:
            if not file.parent.is_dir():
                file.parent.mkdir(parents=True)
            file.write_bytes(content)

    @contextmanager
    def no_harm(self, what: str) -> Iterator[None]:
        """Note an error of any other kind than slatprep's own."""
        try:
            yield
        except SlatprepError:
            pass
        except Exception:  # What must not happen is what is looked for.
            self.harm.append(f"{what}\n{traceback.format_exc(limit=-6)}")


# -- flips ------------------------------------------------------------------


def flip(bench: Bench, number: int) -> None:
    """Flip one bit, and count what came of it."""
    file = bench.any_file()
    at, bit = bench.chance.randrange(file.stat().st_size), bench.chance.randrange(8)
    what = f"{bench.name(file)}, byte {at}, bit {bit}"
    with bench.changed(file) as content, bench.no_harm(what):
        damaged = bytearray(content)
        damaged[at] ^= 1 << bit
        file.write_bytes(damaged)
        found = is_found(bench, file)
        if found and number % WHOLE_EVERY == 0:
            bench.told["found, and the next build"] += 1
            heal(bench, what, verified=True)
        if file.name == seen.NAME:  # It tells a build what not to hash, and nothing else.
            bound = ArrayFile(BytesIO(content))["bound"].tobytes()
            believed, _ = seen.read_seen(bench.manifests, bound)
            if number % SEEN_EVERY == 0 or believed:
                heal(bench, what, verified=False)
            outcome = "costs the next build some hashing"
        else:
            outcome = "found by verify" if found else _unfound(bench, file, content, bytes(damaged))
        bench.told[outcome] += 1
        if outcome == "harm":
            bench.harm.append(f"{what}: neither found nor healed, and not without meaning")


def is_found(bench: Bench, file: Path) -> bool:
    """Whether the parts of `verify_store` that look at a file find something wrong with it."""
    if file.parent == bench.manifests:
        return any(manifest_findings(bench.opened, bench.manifests))
    name = file.relative_to(bench.store).as_posix()
    if file.name == "zarr.json" or name.startswith("file/"):
        try:
            store = open_store(bench.store)
        except StoreError:
            return True
        return any(metadata_findings(bench.store)) or bool(file_findings(store, 1, name)[1])
    return bool(file_findings(bench.opened, 1, name)[1])


def _unfound(bench: Bench, file: Path, sound: bytes, damaged: bytes) -> str:
    if _said(sound) == _said(damaged):
        return "without meaning"
    heal(bench, bench.name(file), verified=False)
    return "healed by the next build" if _said(file.read_bytes()) == _said(sound) else "harm"


def _said(text: bytes) -> list[Any]:
    """Return the documents of a file of JSON, without what tells of a run alone."""
    try:
        lines = [json.loads(text)]
    except ValueError:
        try:
            lines = [json.loads(line) for line in text.splitlines()]
        except ValueError:
            return [text]
    for line in lines:
        for key in UNSAID:
            if isinstance(line, dict) and key in line:
                line[key] = None
    return lines


def heal(bench: Bench, what: str, verified: bool) -> None:
    """Build over a damaged store; it must be as it was then, or be refused in words."""
    if verified and verify_store(bench.store).ok:
        bench.harm.append(f"{what}: found by a part of verify, and not by all of it")
    aside = bench.store.with_name("aside.zarr")
    shutil.copytree(bench.store, aside)
    try:
        bench.build()
        if tree(bench.store) != bench.sound:
            bench.harm.append(f"{what}: the next build is not the store that it was")
        if not verify_store(bench.store).ok:
            bench.harm.append(f"{what}: the next build is not found sound")
    except StoreError:
        bench.told["refused by the next build"] += 1
        shutil.rmtree(bench.store)
        shutil.copytree(aside, bench.store)
    finally:
        shutil.rmtree(aside)
        bench.opened = open_store(bench.store) if (bench.store / "zarr.json").exists() else None


# -- stores -----------------------------------------------------------------


def mutate(bench: Bench) -> None:
    """Damage one file grossly, and read the store by a command."""
    file = bench.any_file()
    kind, change = bench.chance.choice(MUTATIONS)
    command = bench.chance.choice(COMMANDS)
    out = Path(tempfile.mkdtemp(prefix="damage-out-"))
    places = {"store": bench.store, "out": out, "data": bench.dataset.root, "beside": bench.beside}
    line = [part.format(**places) for part in command]
    what = f"{bench.name(file)} {kind}: slatprep {' '.join(line)}"
    with bench.changed(file) as content:
        change(bench, file, content)
        signal.alarm(SECONDS_A_COMMAND)
        try:
            result = CliRunner().invoke(slatprep, line)
        except TimeoutError:
            bench.harm.append(f"{what}: hangs")
            return
        finally:
            signal.alarm(0)
            shutil.rmtree(out)
            if file.is_dir():
                shutil.rmtree(file)
    bench.told[f"{command[0]}: exit code {result.exit_code}"] += 1
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        trace = "".join(traceback.format_exception(result.exception, limit=-6))
        bench.harm.append(f"{what}\n{trace}")


def _cut(bench: Bench, file: Path, content: bytes) -> None:
    file.write_bytes(content[: bench.chance.randrange(len(content))])


def _extend(bench: Bench, file: Path, content: bytes) -> None:
    file.write_bytes(content + bench.chance.randbytes(bench.chance.randrange(1, 5000)))


def _remove(bench: Bench, file: Path, content: bytes) -> None:
    file.unlink()


def _make_folder(bench: Bench, file: Path, content: bytes) -> None:
    file.unlink()
    file.mkdir()


def _exchange(bench: Bench, file: Path, content: bytes) -> None:
    file.write_bytes(bench.chance.choice(bench.files).read_bytes())


def _overwrite(bench: Bench, file: Path, content: bytes) -> None:
    at = bench.chance.randrange(len(content))
    new = bench.chance.choice((bytes(16), b"\xff" * 16, bench.chance.randbytes(16), b"[" * 2000))
    file.write_bytes(content[:at] + new + content[at + len(new) :])


def _edit(bench: Bench, file: Path, content: bytes) -> None:
    """Replace an entry of JSON, or remove or repeat it; of other files, some bytes."""
    try:
        document = json.loads(content)
    except ValueError:
        _overwrite(bench, file, content)
        return
    part, key = document, None
    while isinstance(part, dict | list) and part and (key is None or bench.chance.random() < 0.8):
        keys = list(part) if isinstance(part, dict) else range(len(part))
        above, key = part, bench.chance.choice(keys)
        part = above[key]
    if key is not None:
        if bench.chance.random() < 0.2:
            del above[key]
        else:
            above[key] = bench.chance.choice(HOSTILE)
    file.write_text(json.dumps(document))


MUTATIONS: tuple[tuple[str, Callable[[Bench, Path, bytes], None]], ...] = (
    ("cut", _cut), ("extended", _extend), ("removed", _remove), ("made a folder", _make_folder),
    ("exchanged", _exchange), ("overwritten", _overwrite), ("edited", _edit), ("edited", _edit),
)  # fmt: skip

COMMANDS = (
    ("info", "{store}"),
    ("verify", "{store}"),
    ("verify", "{store}", "--sources"),
    ("report", "{store}", "--out", "{out}/r.html"),
    ("describe", "{store}"),
    ("export", "{store}", "--format", "npz", "--out", "{out}/e"),
    ("export", "{store}", "--format", "ply", "--frame", "pixieverse", "--out", "{out}/e"),
    ("check-alignment", "--store", "{store}", "--asset", "a"),
    ("list", "{store}"),
    ("subset", "{store}", "--verdict", "good", "--out", "{out}/s.zarr"),
    ("publish", "{store}", "--out", "{out}/hub", "--pictures", "1"),
    ("evaluate", "{beside}/predictions", "--store", "{store}", "--split", "all"),
    ("transfer", "{beside}/p.npy", "--store", "{store}", "--asset", "a", "--out", "{out}/p.ply"),
    (
        "train", "{store}", "--out", "{out}/run", "--size", "small", "--epochs", "1",
        "--shares", "0.4,0.3,0.3", "--threads", "1",
    ),
    (
        "build-store", "--pixieverse", "{data}/pixieverse", "--slat", "{data}/slat",
        "--out", "{store}", "--dry-run",
    ),
)  # fmt: skip
"""Commands that read a store and leave it as it is."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after these")
    parser.add_argument("--flips", type=int, default=100_000)
    parser.add_argument("--stores", type=int, default=5_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    signal.signal(signal.SIGALRM, _time_is_up)
    with tempfile.TemporaryDirectory(prefix="damage-") as folder:
        dataset = Dataset(Path(folder) / "sources")
        for seed, object_id in enumerate("abc"):
            dataset.add(object_id, seed, views=("", "side")[: 1 + seed % 2])
        dataset.write_grid("lone", make_asset(3).grid)
        begin = time.monotonic()
        half = begin + 30 * given.minutes
        bench = Bench(dataset, Path(folder, "s.zarr"), random.Random(given.seed), half)
        flips = stores = 0
        while flips < given.flips and bench.time_left():
            flip(bench, flips)
            flips += 1
        bench.until = begin + 60 * given.minutes
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numbers that no sound store holds
            while stores < given.stores and bench.time_left():
                mutate(bench)
                stores += 1
    for harm in bench.harm:
        print(harm, file=sys.stderr)
    told = {"flips": flips, "stores": stores, "harm": len(bench.harm), **sorted_counts(bench.told)}
    print(json.dumps({**told, "seconds": round(time.monotonic() - begin, 1)}, indent=2))
    sys.exit(bool(bench.harm))


def sorted_counts(told: Counter[str]) -> dict[str, int]:
    return dict(sorted(told.items()))


def _time_is_up(*_: object) -> None:
    raise TimeoutError


assert checkout.ROOT  # Importing it made the tests' data known.

if __name__ == "__main__":
    main()

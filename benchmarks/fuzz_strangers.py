"""Feed hostile checkpoints and PLY files to their readers, and measure the cost of a refusal.

    python benchmarks/fuzz_strangers.py [--files 500] [--seed 0] [--kind checkpoint|ply]

Checkpoints are changed in their values, their pickle, their archive and their bytes. PLY files
come from a grammar of features on which readers differ. One file in eight is enlarged to 20 to
100 MB. Each file is read in a process of its own. It must be read, or refused with slatprep's own
error. A refusal may take 200 MB and 2 s of CPU; no file may take a minute or more than 1 GB.
"""

from __future__ import annotations

import argparse
import io
import json
import multiprocessing
import pickle
import random
import resource
import struct
import sys
import tempfile
import time
import traceback
import zipfile
from collections import Counter, OrderedDict
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzz_damage import damage

from slatprep.errors import InputError
from slatprep.learn.decoder import make_decoder
from slatprep.learn.predict import checkpoint_state, load_checkpoint
from slatprep.normalize import PIXIE_RANGES
from slatprep.particles.read import read_particles

REFUSED_MB, REFUSED_S = 200, 2.0
READ_MB, SECONDS_A_FILE = 1000, 60

# --- checkpoints ------------------------------------------------------------------------------


def shared(chance: random.Random) -> Any:
    """Return a nest of containers that refer to each other, so that it has leaves without end."""
    kind = chance.choice((list, tuple, lambda parts: dict(enumerate(parts))))
    inner: Any = (0.0,) * 10
    for _ in range(chance.choice((3, 9, 40, 200))):
        inner = kind([inner] * 10)
    return inner


def hostile_value(chance: random.Random) -> Any:
    wide = torch.zeros(1).expand(*[chance.choice((1, 10**5, 2**30))] * chance.choice((1, 2)))
    return chance.choice(
        (
            shared(chance), None, True, -1, 2**70, 10**5000, float("nan"), 1e308, "", "\ud800",
            "x" * 10**6, "large", "../../x", [], {}, (), [[0.0, 1.0]] * 10**5, [[1.0, 0.0]] * 3,
            {"a": 1}, OrderedDict(), torch.zeros(3), torch.full((3, 2), torch.nan), wide,
            torch.empty(0), torch.zeros(2, 2, dtype=torch.complex64), torch.zeros(2).bool(),
            torch.sparse_coo_tensor([[0], [0]], [1.0], (2**31, 2**31), check_invariants=True),
            torch.device("cuda"),
            torch.zeros(2, device="meta"), torch.float32, torch.Size([2**40]),
            {f"k{k}": torch.zeros(1) for k in range(2000)}, "[" * 10**5, '{"classes":' * 1000,
        )
    )  # fmt: skip


def change_values(state: dict[str, Any], chance: random.Random) -> None:
    about = state["about"]
    for _ in range(chance.randrange(1, 4)):
        holder: Any = chance.choice((state, state, state["model"]))
        if holder is state and chance.random() < 0.3:
            told = json.loads(about)
            part = chance.choice((told, told["normalization"], told["contents"]))
            part[chance.choice((*part, "x"))] = chance.choice(
                (
                    [],
                    None,
                    2**70,
                    "x" * 10**6,
                    ["a"] * 10**5,
                    [["d", "kg", 3]] * 40,
                    {"a": {}},
                    1e99,
                )
            )
            state["about"] = json.dumps(told)
            continue
        key = chance.choice((*holder, "other", 3, ("a",)))
        if chance.random() < 0.15:
            holder.pop(key, None)
        else:
            holder[key] = hostile_value(chance)
        if not isinstance(state.get("model"), dict):
            state["model"] = {}


def repack(data: bytes, change: Callable[[str, bytes], bytes]) -> bytes:
    """Return an archive with members changed."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w") as new:
        for info in old.infolist():
            new.writestr(info.filename, change(info.filename, old.read(info)))
    return out.getvalue()


OPCODES = (
    b"]", b"}", b")", b"(", b"N", b"\x88", b"K\x00", b"l", b"t", b"d", b"a", b"s", b"e", b"u",
    b"q\x00", b"h\x00", b"r\xff\xff\xff\x7f", b"j\xff\xff\xff\x7f", b"\x94", b"Q", b"R", b"b",
    b"0", b"2", b"\x85", b"\x86", b"\x87", b"\x8b\xff\xff\xff\x7f",
    b"\x8b\x00\x00\x01\x00" + b"\x7f" * 65536,
    b"X\xff\xff\xff\x7f", b"\x8d" + b"\xff" * 7 + b"\x7f", b"\x95" + b"\xff" * 7 + b"\x7f",
    b"ctorch._utils\n_rebuild_tensor_v2\n", b"ctorch\nTensor\n", b"ctorch\nFloatStorage\n",
    b"ccollections\nOrderedDict\n", b"ctorch\nzeros\n", b"ctorch._utils\n_rebuild_parameter\n",
    b"ctorch._utils\n_rebuild_sparse_tensor\n", b"cos\nsystem\n", b"ctorch\nload\n",
    b"ctorch\nSize\n",
    b"ctorch._utils\n_rebuild_meta_tensor_no_storage\n", b"ctorch.serialization\n_get_layout\n",
)  # fmt: skip


def change_pickle(data: bytes, chance: random.Random) -> bytes:
    def change(name: str, content: bytes) -> bytes:
        if not name.endswith("data.pkl"):
            return content
        if chance.random() < 0.4:
            unit = b"".join(chance.choices(OPCODES, k=chance.randrange(1, 5)))
            size = chance.choice((100, 10**4, 10**6, 3 * 10**6))
            times = min(size // len(unit), 10**6)
            return b"\x80\x02" + unit * times + chance.choice((b".", content[2:]))
        for _ in range(chance.randrange(1, 6)):
            at = chance.randrange(2, len(content))
            edit = b"".join(chance.choices(OPCODES, k=chance.randrange(1, 4)))
            content = content[:at] + edit + content[at + chance.choice((0, 0, 1, 5)) :]
        return content

    return repack(data, change)


def overlapping(data: bytes, times: int) -> bytes:
    """Return an archive whose directory names one member again and again."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        start = archive.start_dir
        largest = max(archive.infolist(), key=lambda info: info.file_size)
        prefix = largest.filename.rpartition("/")[0]
    end = data.rindex(b"PK\x05\x06")
    entries = data[start:end]
    at = entries.index(largest.filename.encode()) - 46
    _, extra, comment = struct.unpack_from("<3H", entries, at + 28)
    one = entries[at : at + 46]
    tail = entries[at + 46 + len(largest.filename) :][: extra + comment]
    for number in range(times):
        name = f"{prefix}/{1000 + number}".encode()
        entries += one[:28] + struct.pack("<H", len(name)) + one[30:] + name + tail
    count = min(zipfile.ZipFile(io.BytesIO(data)).infolist().__len__() + times, 65535)
    return (
        data[:start]
        + entries
        + struct.pack("<4s4H2LH", b"PK\x05\x06", 0, 0, count, count, len(entries), start, 0)
    )


def change_archive(data: bytes, chance: random.Random) -> bytes:
    kind = chance.randrange(7)
    if kind == 0:
        return overlapping(data, chance.choice((10, 1000, 30_000)))
    out = io.BytesIO(data)
    method = zipfile.ZIP_DEFLATED if kind == 1 else zipfile.ZIP_STORED
    with zipfile.ZipFile(out, "a", method) as archive:
        prefix = archive.namelist()[0].partition("/")[0]
        if kind in (1, 2):
            archive.writestr(f"{prefix}/data/99999", bytes(chance.choice((10, 10**6, 5 * 10**7))))
        elif kind == 3:
            for number in range(chance.choice((10, 3000, 60_000))):
                archive.writestr(f"{prefix}/data/x{number}", b"")
        elif kind == 4:
            archive.writestr(chance.choice((f"{prefix}/data.pkl", "x/data.pkl")), b"\x80\x02N.")
        elif kind == 5:
            archive.comment = bytes(chance.randrange(65535))
        else:
            archive.writestr(f"{prefix}/constants.pkl", b"\x80\x02" + b"]" * 10**6 + b".")
    return out.getvalue()


def make_checkpoint(chance: random.Random) -> bytes:
    state = checkpoint_state(make_decoder("small"), "small", PIXIE_RANGES)
    kind = chance.choice(("values", "values", "pickle", "archive", "bytes"))
    if kind == "values":
        change_values(state, chance)
    if chance.random() < 1 / 8:
        rows = chance.randrange(5 * 10**6, 24 * 10**6)
        holder = chance.choice((state, state["model"]))
        holder[chance.choice(("optimizer", "other", *state["model"]))] = torch.zeros(rows)
        if kind not in ("values", "bytes"):
            state["about"] = None
    out = io.BytesIO()
    try:
        torch.save(state, out)
    except (RecursionError, RuntimeError, NotImplementedError, UnicodeError, pickle.PicklingError):
        return make_checkpoint(chance)
    data = out.getvalue()
    if kind == "pickle":
        return change_pickle(data, chance)
    if kind == "archive":
        return change_archive(data, chance)
    if kind == "bytes":
        seed = np.random.default_rng(chance.randrange(2**32))
        tail = chance.choice((0, len(data) - 20_000))
        return data[:tail] + damage(data[tail:], seed)
    return data


# --- PLY --------------------------------------------------------------------------------------

TYPES = (
    "float", "float32", "double", "uchar", "char", "int", "uint8", "ushort", "int64", "FLOAT",
    "list",
    "list uchar int", "list float uchar", "list int double", "list uchar", "list char char", "",
)  # fmt: skip
COUNTS = (*["{}"] * 24, "0", "-1", "+3", "1_000", "3.0", "1e9", "9" * 30, "٣", "", "x")


def make_ply(chance: random.Random) -> bytes:
    little = ["binary_little_endian"] * 6
    form = chance.choice((*little, "binary_big_endian", "ascii", "ascii", "binary", ""))
    size = chance.randrange(20 * 10**6, 100 * 10**6) if chance.random() < 1 / 8 else 4000
    stride = 12
    lines = ["ply", f"format {form} {chance.choice(('1.0',) * 8 + ('2.0', ''))}"]
    for element in chance.choice(
        (*[["vertex"]] * 6, ["vertex", "face"], ["junk", "vertex"], ["vertex"] * 2, ["face"], [])
    ):
        rows = max(int(size / stride * chance.choice((1, 1, 1, 1, 0.999, 0.01, 1.01, 1e5))), 0)
        lines.append(f"element {element} " + chance.choice(COUNTS).format(rows))
        names = ["x", "y", "z"] if element == "vertex" and chance.random() < 0.9 else []
        names += chance.choices(
            ("x", "nx", "f_dc_0", "w", "é", "a b", ""), k=chance.choice((0, 0, 0, 0, 1, 5))
        )
        if chance.random() < 0.03:
            names += [f"p{k}" for k in range(chance.choice((300, 20_000)))]
        for name in names:
            kind = "float" if chance.random() < 0.95 else chance.choice(TYPES)
            lines.append(f"property {kind} {name}")
    for _ in range(chance.choice((0, 0, 0, 1, 3))):
        extra = chance.choice(
            ("comment " + "c" * chance.choice((9, 10**5, 10**6)), "obj_info x", "", "end_header x",
             "property float q", "element", "format ascii 1.0", "comment end_header", "\0", "PLY")
        )  # fmt: skip
        lines.insert(chance.randrange(1, len(lines) + 1), extra)
    if chance.random() < 0.95:
        lines.append("end_header")
    end = chance.choice(("\n", "\n", "\n", "\r\n", "\r"))
    head = (end.join(lines) + chance.choice((*[end] * 8, "\n", ""))).encode("utf-8", "replace")
    if form == "ascii":
        row = chance.choice((*[b"0 0 0\n"] * 6, b"0\n", b"1 2 3 4\n", b"9" * 400, b"nan 0 0\n"))
        return head + row * (size // len(row))
    body = np.zeros(size // 4, dtype=np.float32)
    if chance.random() < 0.5 and len(body):
        body[chance.choice((0, len(body) // 2, -1))] = chance.choice((np.nan, np.inf, 1e38))
    return head + body.tobytes()[: -1 if chance.random() < 0.1 else None]


KINDS: dict[str, tuple[str, Callable[[random.Random], bytes], Callable[[Path], object]]] = {
    "checkpoint": ("best.pt", make_checkpoint, load_checkpoint),
    "ply": ("p.ply", make_ply, read_particles),
}

# --- all files --------------------------------------------------------------------------------


def memory(name: str) -> int:
    """Return a line of this process's state in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))


def read_apart(read: Callable[[Path], object], file: Path, told: Connection) -> None:
    """Read a file in this process; tell what came of it, its CPU seconds and its MB."""
    resource.setrlimit(resource.RLIMIT_AS, (24 * 2**30, 24 * 2**30))
    before, begin = memory("VmRSS"), time.process_time()
    try:
        read(file)
        outcome = "read"
    except InputError as error:
        outcome = "refused" if len(str(error)) < 2000 and "\n" not in str(error) else "too long"
    except BaseException:
        outcome = traceback.format_exc(limit=-4)
    told.send((outcome, time.process_time() - begin, (memory("VmHWM") - before) / 1e6))


def fuzz(kind: str, number: int, seed: int, folder: Path) -> tuple[str, str, float, float]:
    """Read a file made from a seed; return the outcome, what is wrong with it, MB and seconds."""
    name, make, read = KINDS[kind]
    (folder / name).write_bytes(make(random.Random(f"{seed} {kind} {number}")))
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(
        target=read_apart, args=(read, folder / name, sender)
    )
    process.start()
    sender.close()
    process.join(SECONDS_A_FILE)
    if process.is_alive():
        process.kill()
        return "fault", "hangs", 0.0, SECONDS_A_FILE
    if process.exitcode or not receiver.poll():
        return "fault", f"ends with {process.exitcode}", 0.0, 0.0
    outcome, seconds, mb = receiver.recv()
    wrong = "" if outcome in ("read", "refused") else outcome
    if (outcome == "refused" and (mb > REFUSED_MB or seconds > REFUSED_S)) or mb > READ_MB:
        wrong = f"{outcome} for {mb:.0f} MB and {seconds:.1f} s"
    return ("fault" if wrong else outcome), wrong, mb, seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=500, help="files of each kind")
    parser.add_argument("--first", type=int, default=0, help="number of the first file")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", action="append", choices=KINDS)
    given = parser.parse_args()
    torch.set_num_threads(1)
    faults = 0
    for kind in given.kind or KINDS:
        told: Counter[str] = Counter()
        most = {"refused": [0.0, 0.0], "read": [0.0, 0.0], "fault": [0.0, 0.0]}
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "warm").write_bytes(b"ply\nelement vertex 0\nend_header\n")
            for number in range(given.first, given.first + given.files):
                outcome, wrong, mb, seconds = fuzz(kind, number, given.seed, Path(folder))
                told[outcome] += 1
                most[outcome] = [max(most[outcome][0], mb), max(most[outcome][1], seconds)]
                if wrong:
                    print(f"{kind} {number}: {wrong}", file=sys.stderr, flush=True)
        faults += told["fault"]
        print(f"{kind}: {dict(told)}; most MB and s: {most}", flush=True)
    sys.exit(bool(faults))


if __name__ == "__main__":
    main()

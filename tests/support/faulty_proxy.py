"""A proxy before an S3 server that spoils some of the answers, by a seed.

What happens to a request follows from the seed, the method, the address and
how often both were asked for, so that a run can be repeated whatever the
order in which requests come.
"""

import http.client
import random
import re
import socket
import struct
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

HOP = {"connection", "keep-alive", "transfer-encoding", "content-length", "date", "server"}
"""Headers that are the connection's own."""

ERRORS = {
    "500": ("InternalError", "We encountered an internal error. Please try again."),
    "503": ("SlowDown", "Please reduce your request rate."),
    "403": ("AccessDenied", "Access Denied"),
    "404": ("NoSuchKey", "The specified key does not exist."),
    "409": ("ConditionalRequestConflict", "A conflicting operation occurred."),
    "412": ("PreconditionFailed", "At least one of the pre-conditions did not hold."),
}
"""What S3 says with each status."""

BEFORE = ("500", "503", "reset", "delay")
"""What may happen to any request before the server hears of it."""

AFTER = ("lost", "lost 500", "twice")
"""What may happen to any request that the server answers: nobody hears, or it comes twice."""

ANOTHER = "another's"
"""The answer is that of another object, as from a cache that mixes them up."""

READING = ("truncated", "short", "long", "flipped", "404", "403", ANOTHER)
"""What may happen to an answer that has content."""

LISTING = ("truncated", "stale")
CONDITIONAL = ("409", "412")
UPLOAD = "upload flipped"
"""What may happen to what is put there: the server takes it with another bit."""

KINDS = (*BEFORE, *AFTER, *READING, "stale", *CONDITIONAL, UPLOAD)

CHANGING = re.compile(r"list-type|current\.json")
"""Addresses whose answers change, and may be stale: listings, and the pointer of a store."""

ANY_NUMBER = -1


@dataclass
class Faults:
    """What the proxy does; nothing while `chance`, the share of requests it spoils, is 0.

    Only what has an address of the pattern `only` meets one of the `kinds`, and the same again
    where that is `lasting`. Of every connection `rate` is the bytes a second: 0 for as many as
    there may be, below 0 for no answer. `told` counts what happened.
    """

    seed: str = ""
    chance: float = 0.0
    kinds: tuple[str, ...] = KINDS
    lasting: bool = False
    only: str = ""
    rate: float = 0.0
    told: Counter[str] = field(default_factory=Counter)
    _asked: Counter[str] = field(default_factory=Counter)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def draw(self, method: str, address: str, conditional: bool) -> tuple[str, random.Random]:
        """Return what happens to a request, "" for nothing, and the chance for its details."""
        with self._lock:
            self._asked[f"{method} {address}"] += 1
            times = ANY_NUMBER if self.lasting else self._asked[f"{method} {address}"]
        chance = random.Random(f"{self.seed} {method} {address} {times}")
        if chance.random() >= self.chance or not re.search(self.only, address):
            return "", chance
        fitting = [*BEFORE, *AFTER, *(CONDITIONAL if conditional else ())]
        fitting += [UPLOAD] if method == "PUT" else []
        if method in ("GET", "HEAD"):
            fitting += LISTING if "list-type" in address else READING
            fitting += ["stale"] if "current.json" in address else []
        kinds = [kind for kind in fitting if kind in self.kinds]
        kind = chance.choice(kinds) if kinds else ""
        if kind:
            with self._lock:
                self.told[kind] += 1
        return kind, chance


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True  # A body would wait 40 ms for the ACK of its head.
    server: "_Server"

    def handle_one_request(self) -> None:
        try:
            super().handle_one_request()
        except OSError:  # The client went, or was sent away.
            self.close_connection = True

    def answer(self) -> None:
        """Pass a request on, with or without a fault."""
        body = self._body()
        if self.server.faults.rate:
            time.sleep(600 if self.server.faults.rate < 0 else len(body) / self.server.faults.rate)
        conditional = bool(self.headers.get("If-Match") or self.headers.get("If-None-Match"))
        kind, chance = self.server.faults.draw(self.command, self.path, conditional)
        if kind == "delay":
            time.sleep(0.3 * chance.random())
        if kind == "reset":
            self._reset()
        elif kind in ERRORS:
            self._refuse(kind)
        else:
            asked = self.server.asked
            if "list-type" not in self.path and self.path not in asked:
                asked.append(self.path)
            path = chance.choice(asked) if kind == ANOTHER and asked else ""
            status, headers, content = self._forward(
                _flipped(body, chance) if body and kind == UPLOAD else body, path
            )
            if kind == "twice":
                status, headers, content = self._forward(body)
            self._reply(kind, chance, status, headers, content)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = answer  # noqa: N815

    def log_message(self, *_: object) -> None:
        """Say nothing."""

    def _body(self) -> bytes:
        if self.headers.get("Transfer-Encoding", "").lower() != "chunked":
            return self.rfile.read(int(self.headers.get("Content-Length") or 0))
        parts = []
        while size := int(self.rfile.readline().split(b";")[0], 16):
            parts.append(self.rfile.read(size))
            self.rfile.readline()
        self.rfile.readline()
        return b"".join(parts)

    def _forward(self, body: bytes, path: str = "") -> tuple[int, list[tuple[str, str]], bytes]:
        upstream = http.client.HTTPConnection(self.server.upstream, timeout=60)
        headers = {k: v for k, v in self.headers.items() if k.lower() not in (*HOP, "expect")}
        upstream.request(
            self.command, path or self.path, body, {**headers, "Content-Length": len(body)}
        )
        with upstream.getresponse() as response:
            content = response.read()
            kept = [(k, v) for k, v in response.getheaders() if k.lower() not in HOP]
            if self.command == "HEAD":
                kept.append(("Content-Length", response.getheader("Content-Length") or "0"))
        upstream.close()
        return response.status, kept, content

    def _reply(
        self,
        kind: str,
        chance: random.Random,
        status: int,
        headers: list[tuple[str, str]],
        content: bytes,
    ) -> None:
        known = self.server.known[f"{self.command} {self.path}"]
        if kind == "stale" and known:
            status, headers, content = chance.choice(known)
        elif status == 200 and CHANGING.search(self.path) and content not in [k[2] for k in known]:
            known.append((status, headers, content))
        if kind == "lost":
            return self._reset()
        if kind == "lost 500":
            return self._refuse("500")
        if self.command == "HEAD":
            length = dict(headers)["Content-Length"]
            wrong = int(length) + {"short": -1, "long": 1}.get(kind, 0)
            headers = [(k, v) for k, v in headers if k != "Content-Length"]
            return self._send(status, headers, b"", max(wrong, 0))
        if content and kind == "short":
            content = content[: chance.randrange(len(content))]
        elif kind == "long":
            content += chance.randbytes(chance.randrange(1, 2000))
        elif content and kind == "flipped":
            content = _flipped(content, chance)
        if content and kind == "truncated":
            self._send(status, headers, content[: chance.randrange(len(content))], len(content))
            return self._reset()
        self._send(status, headers, content, len(content))

    def _send(
        self, status: int, headers: list[tuple[str, str]], content: bytes, length: int
    ) -> None:
        self.send_response(status)
        for name, value in headers:
            self.send_header(name, value)
        self.send_header("Content-Length", str(length))
        self.end_headers()
        rate = max(int(self.server.faults.rate), 0)
        for start in range(0, len(content), rate or max(len(content), 1)):
            self.wfile.write(content[start : start + rate] if rate else content)
            self.wfile.flush()
            time.sleep(1.0 if rate else 0.0)

    def _refuse(self, status: str) -> None:
        code, message = ERRORS[status]
        content = (
            f'<?xml version="1.0" encoding="UTF-8"?><Error><Code>{code}</Code>'
            f"<Message>{message}</Message><RequestId>0</RequestId></Error>"
        ).encode()
        empty = self.command == "HEAD"
        self._send(int(status), [("Content-Type", "application/xml")], b"" if empty else content,
                   0 if empty else len(content))  # fmt: skip

    def _reset(self) -> None:
        """Close the connection so that the client is told that it was reset."""
        self.connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        self.connection.close()
        self.close_connection = True


def _flipped(content: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(content))
    flipped = bytes([content[at] ^ 1 << chance.randrange(8)])
    return content[:at] + flipped + content[at + 1 :]


class _Server(ThreadingHTTPServer):
    daemon_threads = True
    upstream: str
    faults: Faults

    def __init__(self, upstream: str, faults: Faults) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.upstream, self.faults = urlsplit(upstream).netloc, faults
        # Earlier answers, of which a stale one is chosen.
        self.known: defaultdict[str, list[tuple[int, list[tuple[str, str]], bytes]]]
        self.known = defaultdict(list)
        self.asked: list[str] = []
        """Addresses of objects that were asked for, of which another's is chosen."""

    def handle_error(self, *_: object) -> None:
        """Say nothing: clients go away."""


@contextmanager
def faulty(upstream: str, faults: Faults) -> Iterator[str]:
    """Run the proxy before a server; yield its address."""
    with _Server(upstream, faults) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()

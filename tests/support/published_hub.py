"""A hub that serves datasets of any size by ranges, commit by commit, and misbehaves on request."""

import hashlib
import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from io import BytesIO
from pathlib import Path
from typing import BinaryIO
from urllib.parse import parse_qs, unquote, urlsplit

_PIECE = 2**20


class PublishedHub(ThreadingHTTPServer):
    """Datasets by name; each commit is a folder, and the last one is ``main``."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.commits: dict[str, dict[str, Path]] = {}
        self.token = ""
        """Who does not send it is sent away; empty: all are welcome."""
        self.refused, self.wait = 0, 0
        """Answers to come that are 429, and the seconds that they tell to wait."""
        self.cut = 0
        """Ranges to come that end in the middle."""
        self.elsewhere: PublishedHub | None = None
        """Another server, to which whoever asks for a file is sent."""
        self.delay = 0.0
        self.requests: list[tuple[str, str]] = []
        self.tokens: list[str] = []
        self.bytes, self._lock = 0, threading.Lock()
        threading.Thread(target=self.serve_forever, args=(0.01,), daemon=True).start()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"

    def publish(self, name: str, folder: Path) -> str:
        """Make a folder the newest commit of a dataset; return the commit."""
        commits = self.commits.setdefault(name, {})
        sha = hashlib.sha1(f"{name} {len(commits)} {folder}".encode()).hexdigest()
        commits[sha] = folder
        return sha

    def count(self, method: str, path: str, size: int) -> None:
        with self._lock:
            self.requests.append((method, path))
            self.bytes += size

    def ranges(self) -> int:
        """How many ranges of files were served."""
        return sum("/resolve/" in path for _, path in self.requests)


class _Handler(BaseHTTPRequestHandler):
    server: PublishedHub
    protocol_version = "HTTP/1.1"
    wbufsize = -1

    def do_GET(self) -> None:
        hub = self.server
        time.sleep(hub.delay)
        hub.tokens.append(self.headers.get("Authorization", ""))
        path = unquote(urlsplit(self.path).path).strip("/")
        parts = path.split("/")
        if hub.token and self.headers.get("Authorization") != f"Bearer {hub.token}":
            return self._error(401, "RepoNotFound", path)
        if hub.refused:
            hub.refused -= 1
            return self._error(429, "", path, hub.wait)
        if parts[:2] == ["api", "datasets"]:
            return self._api("/".join(parts[2:4]), parts[4:], path)
        if parts[0] == "datasets" and parts[3] == "resolve":
            return self._file("/".join(parts[1:3]), parts[4], "/".join(parts[5:]), path)
        return self._error(404, "RepoNotFound", path)

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_POST(self) -> None:
        text = self.rfile.read(int(self.headers["Content-Length"])).decode()
        body = json.loads(text) if text.startswith("{") else parse_qs(text)
        parts = unquote(urlsplit(self.path).path).strip("/").split("/")
        _, folder = self._commit("/".join(parts[2:4]), parts[5])
        paths = [folder / name for name in body["paths"]]
        self._json([self._entry(folder, one) for one in paths if one.exists()], "paths-info")

    def _commit(self, name: str, revision: str) -> tuple[str, Path]:
        commits = self.server.commits[name]
        sha = list(commits)[-1] if revision == "main" else revision
        return sha, commits[sha]

    def _api(self, name: str, what: list[str], path: str) -> None:
        try:
            sha, folder = self._commit(name, what[1] if len(what) > 1 else "main")
        except KeyError:
            known = name in self.server.commits
            return self._error(404, "RevisionNotFound" if known else "RepoNotFound", path)
        if what[:1] != ["tree"]:
            return self._json({"id": name, "sha": sha, "private": False, "siblings": []}, path)
        below = folder / "/".join(what[2:])
        if not below.is_dir():
            return self._error(404, "EntryNotFound", path)
        found = below.rglob("*") if "recursive=true" in self.path.lower() else below.iterdir()
        return self._json([self._entry(folder, one) for one in sorted(found)], path)

    def _entry(self, folder: Path, file: Path) -> dict[str, object]:
        name = file.relative_to(folder).as_posix()
        if file.is_dir():
            oid = hashlib.sha1(name.encode()).hexdigest()
            return {"type": "directory", "path": name, "size": 0, "oid": oid}
        size, tag = file.stat().st_size, _tag(file)
        lfs = {"oid": tag, "size": size, "pointerSize": 134}
        return {"type": "file", "path": name, "size": size, "oid": tag[:40], "lfs": lfs}

    def _file(self, name: str, revision: str, file: str, path: str) -> None:
        hub = self.server
        if hub.elsewhere is not None:
            return self._answer(302, path, {"Location": f"{hub.elsewhere.address}{self.path}"})
        try:
            sha, folder = self._commit(name, revision)
            size = (folder / file).stat().st_size
        except (KeyError, FileNotFoundError):
            return self._error(404, "EntryNotFound", path)
        begin, end, asked = 0, size, self.headers.get("Range")
        if asked:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            begin, end = int(first), min(int(last) + 1 if last else size, size)
            if begin >= size:
                return self._error(416, "", path)
        tag = f'"{_tag(folder / file)}"'
        headers = {"ETag": tag, "X-Linked-ETag": tag, "X-Repo-Commit": sha}
        if asked:
            headers["Content-Range"] = f"bytes {begin}-{end - 1}/{size}"
        with (folder / file).open("rb") as stream:
            stream.seek(begin)
            self._answer(206 if asked else 200, path, headers, stream, end - begin)

    def _json(self, document: object, path: str) -> None:
        body = json.dumps(document).encode()
        self._answer(200, path, {"Content-Type": "application/json"}, BytesIO(body), len(body))

    def _error(self, status: int, code: str, path: str, wait: int | None = None) -> None:
        told = {"X-Error-Code": code, "Retry-After": "" if wait is None else str(wait)}
        self._answer(status, path, {name: text for name, text in told.items() if text})

    def _answer(
        self,
        status: int,
        path: str,
        headers: dict[str, str],
        stream: BinaryIO | None = None,
        size: int = 0,
    ) -> None:
        """Send so many bytes of a stream; of a range that is to be cut, half of them."""
        self.send_response(status)
        for name, value in (headers | {"Content-Length": str(size)}).items():
            self.send_header(name, value)
        self.end_headers()
        sent, left, cut = 0, size, status == 206 and self.server.cut > 0
        if cut:
            self.server.cut -= 1
            self.close_connection, left = True, size // 2
        while self.command != "HEAD" and stream and (data := stream.read(min(left - sent, _PIECE))):
            self.wfile.write(data)
            sent += len(data)
        self.wfile.flush()
        self.server.count(self.command, path, sent)

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing."""


def _tag(file: Path) -> str:
    state = file.stat()
    return hashlib.sha256(f"{file.name} {state.st_size} {state.st_mtime_ns}".encode()).hexdigest()

"""The part of the Hugging Face hub's HTTP interface by which its files are read, over a folder.

Run as ``python hub.py FOLDER``: prints the address, and serves until its
standard input ends. Each ``OWNER/NAME`` below the folder is a dataset with the
one revision ``main``.
"""

import hashlib
import json
import sys
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import parse_qs, unquote, urlsplit


class Hub(BaseHTTPRequestHandler):
    """Answers what `huggingface_hub.HfFileSystem` asks of a public dataset."""

    root: Path
    protocol_version = "HTTP/1.1"
    wbufsize = -1  # Head and body in one packet: a second one waits 40 ms for the first's ACK.

    def do_GET(self) -> None:
        path = unquote(urlsplit(self.path).path).strip("/").split("/")
        if path[:2] == ["api", "datasets"]:
            return self._api("/".join(path[2:4]), path[4:])
        if path[0] == "datasets" and path[3:5] == ["resolve", "main"]:
            return self._file("/".join(path[1:3]), "/".join(path[5:]))
        return self._missing("RepoNotFound")

    def do_HEAD(self) -> None:
        self.do_GET()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"])).decode()
        form = json.loads(body) if body.startswith("{") else parse_qs(body)
        path = unquote(urlsplit(self.path).path).strip("/").split("/")
        repo = self.root / path[2] / path[3]
        asked = [repo / name for name in form["paths"]]
        self._json([self._entry(repo, one) for one in asked if one.exists()])

    def _api(self, repo: str, what: list[str]) -> None:
        folder = self.root / repo
        if not folder.is_dir():
            return self._missing("RepoNotFound")
        if what[:1] == ["tree"]:
            below = folder / "/".join(what[2:])
            if not below.exists():
                return self._missing("EntryNotFound")
            recursive = "recursive=true" in self.path.lower()
            found = sorted(below.rglob("*") if recursive else below.iterdir())
            return self._json([self._entry(folder, one) for one in found])
        return self._json({"id": repo, "sha": "0" * 40, "private": False, "siblings": []})

    def _entry(self, repo: Path, file: Path) -> dict[str, object]:
        kind = "directory" if file.is_dir() else "file"
        name = file.relative_to(repo).as_posix()
        size = 0 if file.is_dir() else file.stat().st_size
        oid = hashlib.sha1(name.encode()).hexdigest()
        return {"type": kind, "path": name, "size": size, "oid": oid}

    def _file(self, repo: str, name: str) -> None:
        file = self.root / repo / name
        if not file.is_file():
            return self._missing("EntryNotFound")
        content, asked = file.read_bytes(), self.headers.get("Range")
        begin, end = 0, len(content)
        if asked:
            first, _, last = asked.removeprefix("bytes=").partition("-")
            begin, end = int(first), min(int(last) + 1 if last else len(content), len(content))
            if begin >= len(content):
                return self._answer(416, b"")
        self._answer(206 if asked else 200, content[begin:end], begin, len(content))

    def _json(self, document: object) -> None:
        self._answer(200, json.dumps(document).encode())

    def _missing(self, code: str) -> None:
        self._answer(404, b"{}", code=code)

    def _answer(
        self, status: int, body: bytes, begin: int = 0, total: int = 0, code: str = ""
    ) -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("ETag", '"0"')
        self.send_header("X-Repo-Commit", "0" * 40)
        if status == 206:
            self.send_header("Content-Range", f"bytes {begin}-{begin + len(body) - 1}/{total}")
        if code:
            self.send_header("X-Error-Code", code)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(body)

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing."""


if __name__ == "__main__":
    Hub.root = Path(sys.argv[1])
    server = ThreadingHTTPServer(("127.0.0.1", 0), Hub)
    threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True).start()
    print(f"http://127.0.0.1:{server.server_port}", flush=True)
    sys.stdin.read()

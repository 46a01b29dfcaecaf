"""What may not be read is told as such: a server answers 403 to whoever asks for a store."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
from support.commands import refused


class _Denying(BaseHTTPRequestHandler):
    """Answer as S3 does whose bucket may be listed, and whose objects may not be read."""

    def do_GET(self) -> None:
        if "list-type" in self.path:
            listed = "<Contents><Key>s.zarr/zarr.json</Key><Size>9</Size></Contents>"
            text = f'<ListBucketResult xmlns="x"><KeyCount>1</KeyCount>{listed}</ListBucketResult>'
            self._answer(200, text)
        elif "current.json" in self.path or "manifests" in self.path:
            self._answer(404, "<Error><Code>NoSuchKey</Code></Error>")
        else:
            self._answer(403, "<Error><Code>AccessDenied</Code><Message>no</Message></Error>")

    def do_HEAD(self) -> None:
        self.do_GET()

    def _answer(self, status: int, text: str) -> None:
        self.send_response(status)
        self.send_header("Content-Type", "application/xml")
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(text.encode())

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def denying(monkeypatch: pytest.MonkeyPatch, new_clients: Callable[[], None]) -> Iterator[None]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), _Denying)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.server_port}")
    new_clients()
    yield
    server.shutdown()


@pytest.mark.parametrize("client", ["obstore", "s3fs"])
@pytest.mark.parametrize("command", ["info", "verify", "describe"])
def test_a_store_that_may_not_be_read_is_no_other_thing(denying, monkeypatch, client, command):
    monkeypatch.setenv("SLATPREP_OBSTORE", "no" if client == "s3fs" else "yes")
    told = refused(command, "s3://bucket/s.zarr", code=1).splitlines()[-1]
    assert told.startswith("slatprep: error: s3://bucket/s.zarr/zarr.json: may not be read (")
    assert "(None)" not in told

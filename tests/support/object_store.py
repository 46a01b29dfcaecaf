"""A real S3 server on loopback, moto's, in a process of its own."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

# moto's own server finds the service of each request in a listing of its folders, and logs it.
_SERVER = """
import sys, threading
from moto.moto_server.werkzeug_app import create_backend_app
from werkzeug.serving import WSGIRequestHandler, make_server

class Handler(WSGIRequestHandler):
    def log_request(self, *_):
        pass

server = make_server("127.0.0.1", 0, create_backend_app("s3"), True, request_handler=Handler)
threading.Thread(target=server.serve_forever, daemon=True).start()
print("http://%s:%s" % server.server_address, flush=True)
sys.stdin.read()  # Until whoever started it ends, however that ends.
"""


@contextmanager
def running() -> Iterator[str]:
    """Run the server; yield its address."""
    with subprocess.Popen(
        [sys.executable, "-c", _SERVER],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        try:
            address = process.stdout.readline().strip()
            assert address, "the server did not start"
            yield address
        finally:
            process.kill()


def environment(address: str, nowhere: str = "/nonexistent") -> dict[str, str]:
    """Return the variables that lead S3's libraries there, and let nobody's own settings in."""
    return {
        "AWS_ENDPOINT_URL": address,
        "AWS_ACCESS_KEY_ID": "key",
        "AWS_SECRET_ACCESS_KEY": "secret",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_CONFIG_FILE": nowhere,
        "AWS_SHARED_CREDENTIALS_FILE": nowhere,
        "SLATPREP_OBSTORE": "no",  # Requests are counted and spoiled in s3fs.
    }

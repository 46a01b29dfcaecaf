"""A real S3 server on loopback, a bucket a test, and made assets to put there."""

import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from joblib.externals.loky import get_reusable_executor
from s3fs.core import S3FileSystem
from support import object_store
from support.remote import Dataset, Made, built, put
from support.synthetic import MakeDataset

from slatprep.parameters import BuildParameters
from slatprep.storage.place import place_of
from slatprep.storage.versions import current_version

Change = Callable[[bytes], bytes]
"""Returns what takes the place of a file's content; nothing where there shall be no file."""


@pytest.fixture(scope="session")
def server() -> Iterator[str]:
    """Run moto's S3 in a process of its own; return its address."""
    with object_store.running() as address:
        yield address


@pytest.fixture(scope="session", autouse=True)
def environment(server: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Say where the server is, and let nobody's own settings in."""
    none = str(tmp_path_factory.mktemp("aws") / "none")
    with pytest.MonkeyPatch.context() as monkeypatch:
        for name, value in object_store.environment(server, none).items():
            monkeypatch.setenv(name, value)
        # Worker processes that other tests left would not have these.
        get_reusable_executor().shutdown(wait=True)
        yield


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Give each test a cache of its own."""
    monkeypatch.setenv("SLATPREP_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def new_clients(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], None]]:
    """Return what makes fsspec forget its clients: they keep the credentials they began with."""
    yield S3FileSystem.clear_instance_cache
    monkeypatch.undo()
    S3FileSystem.clear_instance_cache()


@pytest.fixture
def s3() -> Any:
    """Return a client that sees what others have just written."""
    return fsspec.filesystem("s3", use_listings_cache=False)


def new_bucket() -> str:
    name = f"bucket-{uuid.uuid4().hex[:12]}"
    fsspec.filesystem("s3").mkdir(name)
    return name


@pytest.fixture
def bucket() -> str:
    """Make a bucket of one test."""
    return new_bucket()


@pytest.fixture(scope="session")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return three assets, and the store of them; nobody may change them."""
    return built(tmp_path_factory.mktemp("undisturbed"), *"abc")


@pytest.fixture(scope="session")
def another(tmp_path_factory: pytest.TempPathFactory) -> Made:
    """Return one other asset, and the store of it."""
    return built(tmp_path_factory.mktemp("another"), "z", seed=3)


@pytest.fixture(scope="session")
def published(environment: None, undisturbed: Made) -> str:
    """Return the URL of the store of three assets; none but `damage` may change what is there."""
    url = f"s3://{new_bucket()}/stores/demo.zarr"
    put(undisturbed[1], url)
    return url


@pytest.fixture
def damage(s3: Any, published: str) -> Iterator[Callable[[str, Change], None]]:
    """Return what changes a file of the store at `published` until the test ends."""
    version = current_version(place_of(published))
    before: dict[str, bytes] = {}

    def put_there(place: str, content: bytes) -> None:
        s3.pipe_file(place, content) if content else s3.rm_file(place)

    def change(name: str, how: Change) -> None:
        place = f"{version}/{name}"
        now = s3.cat_file(place) if s3.exists(place) else b""
        before.setdefault(place, now)
        put_there(place, how(now))

    yield change
    for place, content in before.items():
        put_there(place, content)


@pytest.fixture
def make_dataset(tmp_path: Path) -> MakeDataset:
    return lambda *ids: Dataset(tmp_path / "sources").having(*ids)


@pytest.fixture
def uploaded(s3: Any, bucket: str, undisturbed: Made) -> BuildParameters:
    """Put the sources of three assets into the bucket; return the parameters to build them."""
    s3.put(f"{undisturbed[0].root}/", f"{bucket}/data/", recursive=True)
    return Dataset(place_of(f"s3://{bucket}/data")).parameters("pixie")


class Requests:
    """Counts what is asked of the server from this process, by operation and key."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        call = S3FileSystem._call_s3
        self.made: list[tuple[str, str]] = []

        async def counting(filesystem: Any, method: str, *args: Any, **options: Any) -> Any:
            listed = f"{options.get('Prefix')}*{options.get('Delimiter')}"
            self.made.append((method, str(options.get("Key", listed))))
            return await call(filesystem, method, *args, **options)

        monkeypatch.setattr(S3FileSystem, "_call_s3", counting)

    def of(self, method: str) -> list[str]:
        """Return the keys that a method was called with; of listings prefix*delimiter."""
        return [key for name, key in self.made if name == method]


@pytest.fixture
def requests(monkeypatch: pytest.MonkeyPatch) -> Requests:
    """Count requests from here on."""
    return Requests(monkeypatch)


@pytest.fixture
def url(bucket: str) -> str:
    return f"s3://{bucket}/stores/demo.zarr"


@pytest.fixture
def change_client(monkeypatch: pytest.MonkeyPatch, new_clients: Any) -> Callable[[str, Any], None]:
    """Return what has the client of this process do something else."""

    def change(name: str, method: Any) -> None:
        monkeypatch.setattr(S3FileSystem, name, method)
        new_clients()

    return change

"""Laws of places in an object store: read as a folder is, written by nobody, and one error for each kind of trouble."""

import io
import os
import pickle
import shutil
import socket
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import obstore
import pytest

from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log
from t6gps.storage.errors import ConfigError, RunError, StoreError, StoreUnreachableError
from t6gps.storage.objects import place
from t6gps.storage.objects.place import ObjectPath

FILES = {"a.json": b"{}", "empty": b"", "deep/er/b.parquet": bytes(range(256)), "deep/c.json": b"1", ".hidden/d": b"2"}


@pytest.fixture
def folders(objects: ObjectPath, tmp_path: Path) -> tuple[Path, ObjectPath]:
    """The same files in a folder and in a store."""
    for name, content in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(content)
        obstore.put(objects.client(), (objects / name).key, content)
    return tmp_path, objects


READINGS: dict[str, Callable[[Path], object]] = {
    "entries": lambda folder: sorted(path.name for path in folder.iterdir()),
    "some": lambda folder: sorted(path.name for path in folder.glob("*.json")),
    "some below": lambda folder: sorted(str(path.relative_to(folder)) for path in folder.glob("d*/*.json")),
    "all below": lambda folder: sorted(path.name for path in folder.rglob("*.json")),
    "none": lambda folder: list((folder / "nowhere").glob("*")),
    "kinds": lambda folder: [
        (name, (folder / name).exists(), (folder / name).is_file(), (folder / name).is_dir())
        for name in ("a.json", "deep", "deep/er", "dee", "nowhere")
    ],
    "sizes": place.sizes,
    "all sizes": place.below,
    "size": lambda folder: (folder / "deep/er/b.parquet").stat().st_size,
    "bytes": lambda folder: (folder / "empty").read_bytes() + (folder / "deep/c.json").read_bytes(),
    "text": lambda folder: (folder / "a.json").read_text(encoding="utf-8"),
    "digest": lambda folder: durable.sha256(folder / "deep/er/b.parquet"),
    "end": lambda folder: _end(folder / "deep/er/b.parquet"),
    "parent": lambda folder: (folder / "deep/c.json").parent.relative_to(folder).as_posix(),
}


def _end(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(-3, io.SEEK_END)
        return file.read()


@pytest.mark.parametrize("reading", READINGS)
def test_a_store_is_read_as_a_folder(folders: tuple[Path, ObjectPath], reading: str) -> None:
    here, there = map(READINGS[reading], folders)
    assert here == there


@pytest.mark.parametrize("missing", ["nowhere", "a.json/b", "dee"])
def test_what_is_not_there_is_an_error_of_a_file(folders: tuple[Path, ObjectPath], missing: str) -> None:
    asked: list[Callable[[ObjectPath], object]] = [
        ObjectPath.stat,
        ObjectPath.read_bytes,
        lambda path: list(path.iterdir()),
        place.sizes,
    ]
    for ask in asked:
        with pytest.raises(FileNotFoundError, match="no such object"):
            ask(folders[1] / missing)


WRITINGS: dict[str, Callable[[Path], object]] = {
    "make a folder": lambda path: path.mkdir(parents=True),
    "write": lambda path: path.write_bytes(b"1"),
    "append": lambda path: path.open("a"),
    "remove": lambda path: path.unlink(),
    "rename": lambda path: path.rename("elsewhere"),
    "touch": lambda path: path.touch(),
    "copy": lambda path: shutil.copytree(path, "elsewhere"),
    "ask the system": os.path.realpath,
    "create a run": lambda path: catalog.create(path, "run", "{}"),
    "hold a run": lambda path: catalog.locked(catalog.Run(path)).__enter__(),
}


@pytest.mark.parametrize("writing", WRITINGS)
def test_nothing_is_written_there(folders: tuple[Path, ObjectPath], writing: str) -> None:
    before = folders[1].below()
    with pytest.raises(StoreError, match=r"s3://.* is in an object store, which is only read"):
        WRITINGS[writing](folders[1])
    assert folders[1].below() == before


def test_an_address_is_one_place_however_it_is_written(objects: ObjectPath) -> None:
    for written in (Path(str(objects)), Path(objects), objects, pickle.loads(pickle.dumps(objects))):
        assert catalog.whole(written) == objects
        assert str(catalog.whole(written)) == f"s3://{objects.bucket}/{objects.key}"


@pytest.mark.parametrize("address", ["s3://", "s3://Bucket", "s3://b", "s3://bucket/a b", "s3://bucket/a/../b"])
def test_an_address_that_none_can_have_is_refused(objects: ObjectPath, address: str) -> None:
    with pytest.raises(RunError, match=r"s3://BUCKET/PREFIX|choose another prefix"):
        catalog.whole(Path(address))


TROUBLES = {
    "wrong key": ({"AWS_ACCESS_KEY_ID": "nobody"}, StoreError, "refuses .* correct AWS_ACCESS_KEY_ID and AWS_SECRET"),
    "wrong secret": (
        {"AWS_SECRET_ACCESS_KEY": "no"},
        StoreError,
        "refuses .* correct AWS_ACCESS_KEY_ID and AWS_SECRET",
    ),
    "no key": ({"AWS_ACCESS_KEY_ID": ""}, ConfigError, "set AWS_ACCESS_KEY_ID$"),
    "nobody there": ({"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, StoreUnreachableError, "does not answer"),
    "plain text": ({"AWS_ENDPOINT_URL": "http://10.0.0.1"}, ConfigError, "use https, or set AWS_ALLOW_HTTP=true"),
    "no endpoint": ({"AWS_ENDPOINT_URL": "store"}, ConfigError, "must be https://HOST .*, found 'store'"),
}


@pytest.mark.parametrize("trouble", TROUBLES)
def test_each_trouble_has_an_error_with_its_remedy(
    objects: ObjectPath, monkeypatch: pytest.MonkeyPatch, trouble: str
) -> None:
    variables, kind, sentence = TROUBLES[trouble]
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(kind, match=sentence) as caught:
        catalog.list_runs(Path(str(objects)))
    assert "\n" not in str(caught.value)


def test_a_bucket_that_is_not_there_is_named(objects: ObjectPath) -> None:
    with pytest.raises(StoreError, match=r"there is no bucket 'nowhere' at http://.*; make it, or correct"):
        catalog.list_runs(Path("s3://nowhere/runs"))


def test_the_extra_is_named_where_it_is_not_installed(objects: ObjectPath, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "obstore", None)
    with pytest.raises(ConfigError, match=r"install it with: pip install 't6gps\[s3\]'"):
        catalog.list_runs(Path(str(objects)))


def test_other_threads_go_on_while_a_store_does_not_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(240)
        for name, value in (
            ("AWS_ENDPOINT_URL", f"http://127.0.0.1:{server.getsockname()[1]}"),
            ("AWS_ACCESS_KEY_ID", "key"),
            ("AWS_SECRET_ACCESS_KEY", "secret"),
        ):
            monkeypatch.setenv(name, value)
        run = Run(place.whole(Path("s3://lab/runs/rough")))
        with ThreadPoolExecutor(1) as pool:
            opened = pool.submit(log.opened, run, "frames")
            connection, _ = server.accept()  # this thread goes on, and nobody has answered
            assert not opened.done()
            server.settimeout(0.2)
            while not opened.done():  # every try is hung up on
                connection.close()
                with suppress(TimeoutError):
                    connection, _ = server.accept()
            with pytest.raises(StoreUnreachableError, match="does not answer for the bucket 'lab'"):
                opened.result()

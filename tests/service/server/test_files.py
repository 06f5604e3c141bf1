"""Laws of a run's files over HTTP: they come home whole however often the way is cut, and no other file ever leaves."""

from __future__ import annotations

from pathlib import Path
from urllib.parse import quote

import httpx
import pytest
from loopback import Server

from t6gps.service.launch import fetch
from t6gps.service.launch.fetch import FolderSource
from t6gps.service.remote.client import Client
from t6gps.service.remote.messages import Scope
from t6gps.service.remote.source import FarSource, at_hand
from t6gps.storage import catalog
from t6gps.storage.errors import RunError, ServerError


class CutOff(httpx.BaseTransport):
    """A way to a server on which the first answers with a range or a file are cut after some bytes."""

    def __init__(self, cuts: int, after_bytes: int) -> None:
        self.way, self.cuts, self.after_bytes = httpx.HTTPTransport(), cuts, after_bytes
        self.ranges: list[str] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self.way.handle_request(request)
        if request.url.path.endswith("/file"):
            self.ranges.append(request.headers.get("Range", ""))
            if self.cuts:
                self.cuts -= 1
                answer.read()
                part = answer.content[: self.after_bytes]
                return httpx.Response(answer.status_code, stream=Broken(part))
        return answer


class Broken(httpx.SyncByteStream):
    def __init__(self, part: bytes) -> None:
        self.part = part

    def __iter__(self):  # type: ignore[no-untyped-def]
        yield self.part
        raise httpx.ReadError("the connection is cut")


def no_progress(_done: int, _total: int) -> None: ...


def test_a_fetch_that_is_cut_off_again_and_again_goes_on_where_it_was(server: Server, tmp_path: Path) -> None:
    (server.run.figures / "large.png").write_bytes(bytes(range(256)) * 1000)
    way = CutOff(cuts=3, after_bytes=1000)
    with Client(server.url, server.tokens[Scope.READ], transport=way) as client:
        for _ in range(3):
            with pytest.raises(ServerError, match="cut"):
                fetch.fetch(FarSource(client, "walk"), tmp_path, "walk", no_progress)
            assert not catalog.list_runs(tmp_path)
        copy = fetch.fetch(FarSource(client, "walk"), tmp_path, "walk", no_progress)
    assert FolderSource(copy).files() == FolderSource(server.run).files()
    assert any(each.startswith("bytes=") for each in way.ranges)


def test_a_run_at_work_is_not_fetched_but_its_world_is_at_hand(server: Server, tmp_path: Path) -> None:
    server.run.ground.mkdir()
    (server.run.ground / "hill.npy").write_bytes(b"heights")
    with server.client(Scope.READ) as client, catalog.locked(server.run):
        with pytest.raises(RunError, match="in use by process"):
            fetch.fetch(FarSource(client, "walk"), tmp_path, "walk", no_progress)
        with at_hand(client, "walk") as run:
            kept = {str(path.relative_to(run.path)) for path in run.path.rglob("*") if path.is_file()}
            assert run.config_path.read_bytes() == server.run.config_path.read_bytes()
    assert kept == {"config.json", "ground/hill.npy"}
    assert not run.path.exists()


@pytest.mark.parametrize(
    "path",
    ["../other/config.json", "/etc/passwd", ".lock", "", ".", "tables/../../other/config.json", "link", "tables",
     "a" * 999, "no\0file", "./.lock", "figures/../.lock", "\udcff", "../../.server/tokens.json"],
)  # fmt: skip
def test_no_other_file_ever_leaves(server: Server, path: str) -> None:
    catalog.create(server.root, "other", "{}")
    (server.run.path / "link").symlink_to("/etc/passwd")
    with server.http(Scope.READ) as http:
        answer = http.get(f"/v1/runs/walk/file?path={quote(path, safe='', errors='surrogateescape')}")
        assert answer.status_code == 404
        assert answer.json()["kind"] == "ServerError"
        assert http.get("/v1/runs/walk/file", params={"path": "config.json"}).status_code == 200

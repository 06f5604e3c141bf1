"""Laws of fetching: a run comes home whole, verified and once, however often the way is cut."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny_run import Trained

from t6gps.service.launch import fetch
from t6gps.service.launch.fetch import File, FolderSource
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError


class FarSource:
    """A source whose connection is cut after some bytes, or that alters what it sends."""

    def __init__(self, run: Run, cut_after_bytes: int = 10**9, altered: int = 0) -> None:
        self.near, self.left, self.altered = FolderSource(run), cut_after_bytes, altered
        self.sent = 0

    def files(self) -> dict[str, File]:
        return self.near.files()

    def pieces(self, path: str, offset: int) -> Iterator[bytes]:
        for piece in self.near.pieces(path, offset):
            part = piece[: self.left]
            self.left -= len(part)
            self.sent += len(part)
            if self.altered:
                self.altered -= 1
                part = bytes(255 - byte for byte in part)
            yield part
            if not self.left:
                raise ConnectionResetError("the connection is cut")


def no_progress(_done: int, _total: int) -> None: ...


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """A run with a file in two rooms, and a hidden one."""
    run = catalog.create(tmp_path / "far", "a", "{}")
    (run.tables / "part").write_bytes(bytes(range(256)) * 40)
    (run.figures / "picture.png").write_bytes(b"picture")
    (run.path / ".hidden").write_text("")
    return run


def content(run: Run) -> dict[str, File]:
    return FolderSource(run).files()


@pytest.mark.slow
def test_a_run_that_is_fetched_has_the_same_bytes(tiny: Trained, tmp_path: Path) -> None:
    copy = fetch.fetch(FolderSource(tiny.run), tmp_path, "tiny", no_progress)
    assert content(copy) == content(tiny.run)
    assert [found.name for found in catalog.list_runs(tmp_path)] == ["tiny"]
    with catalog.locked(copy):
        pass


def test_a_copy_that_was_cut_off_goes_on_where_it_was(run: Run, tmp_path: Path) -> None:
    whole_bytes = sum(file.size for file in content(run).values())
    home = tmp_path / "home"
    with pytest.raises(RunError, match=r"cannot fetch run a .* the connection is cut"):
        fetch.fetch(FarSource(run, cut_after_bytes=5000), home, "a", no_progress)
    assert not catalog.list_runs(home)
    rest = FarSource(run)
    copy = fetch.fetch(rest, home, "a", no_progress)
    assert rest.sent == whole_bytes - 5000
    assert content(copy) == content(run)


def test_a_file_that_comes_altered_comes_again_and_not_for_ever(run: Run, tmp_path: Path) -> None:
    copy = fetch.fetch(FarSource(run, altered=2), tmp_path / "home", "a", no_progress)
    assert content(copy) == content(run)
    with pytest.raises(RunError, match="came altered 3 times"):
        fetch.fetch(FarSource(run, altered=100), tmp_path / "other", "a", no_progress)
    assert not catalog.list_runs(tmp_path / "other")


def test_what_the_run_no_longer_has_does_not_come_home(run: Run, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="is cut"):
        fetch.fetch(FarSource(run, cut_after_bytes=9000), tmp_path / "home", "a", no_progress)
    (run.tables / "part").rename(run.tables / "other")
    copy = fetch.fetch(FarSource(run), tmp_path / "home", "a", no_progress)
    assert content(copy) == content(run)


def test_a_name_that_is_taken_and_a_run_in_use_are_refused(run: Run, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="exists already; choose another name with --run"):
        fetch.fetch(FolderSource(run), run.path.parent, "a", no_progress)
    with catalog.locked(run), pytest.raises(RunError, match="in use by process"):
        fetch.fetch(FolderSource(run), tmp_path / "home", "a", no_progress)

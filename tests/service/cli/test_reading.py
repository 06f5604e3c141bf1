"""Laws of the commands that read: a damaged run hides no other and is one clear error, and reading writes nothing."""

import errno
import json
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from command import t6gps
from damages import DEEP
from tiny_run import Trained

import t6gps as package
from t6gps.service.training import origin
from t6gps.storage import catalog
from t6gps.storage.errors import T6GpsError


def gap(run: Path) -> None:
    (run / "tables" / "frames" / "_delta_log" / f"{1:020d}.json").unlink()


def ground_lost(run: Path) -> None:
    record = json.loads((run / origin.FILE).read_text())
    record["ground"] = {"file": "ground/hills.npy", "sha256": "0" * 64}
    (run / origin.FILE).write_text(json.dumps(record))


DAMAGES: dict[str, Callable[[Path], object]] = {
    "gap in a log": gap,
    "missing table": lambda run: shutil.rmtree(run / "tables" / "iterations"),
    "missing tables": lambda run: shutil.rmtree(run / "tables"),
    "empty tables": lambda run: [shutil.rmtree(table) for table in (run / "tables").iterdir()],
    "a configuration of brackets": lambda run: (run / "config.json").write_text(DEEP),
    "unreadable configuration": lambda run: (run / "config.json").write_bytes(b"\xff\xfe{"),
    "missing configuration": lambda run: (run / "config.json").unlink(),
    "missing ground": ground_lost,
}


@pytest.fixture
def root(tiny: Trained, tmp_path: Path) -> Path:
    """A root of this test's own with the run `tiny`."""
    shutil.copytree(tiny.run.path, tmp_path / "runs" / "tiny")
    return tmp_path / "runs"


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_run_is_listed_with_the_reason_and_the_others_as_ever(damage: str, root: Path) -> None:
    catalog.copy(catalog.open_run(root, "tiny"), root, "broken")
    DAMAGES[damage](root / "broken")
    lines = t6gps("runs", "--root", root).stdout.decode().splitlines()
    assert any("tiny" in line and "3 of 3" in line for line in lines)
    assert any("broken" in line and "damaged" in line for line in lines)
    (reason,) = (line for line in lines if line.startswith("damaged: "))
    assert str(root / "broken") in reason
    assert [run.name for run in package.runs(root)] == ["broken", "tiny"]


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize(
    "command",
    [
        ("show", "tiny"),
        ("query", "tiny", "SELECT count(*) FROM frames"),
        ("render", "tiny", "1", "--out", "still.png"),
        ("view", "tiny", "1", "--out", "episode.rrd"),
        ("figures", "tiny", "--evaluation", "0"),
        ("eval", "tiny", "--episodes", "2", "--serial"),
    ],
    ids=lambda command: command[0],
)
def test_a_damaged_run_is_one_clear_error_of_whoever_needs_what_is_damaged(
    command: tuple[str, ...], damage: str, root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spared = {
        "show": set[str](),
        "query": {
            "unreadable configuration",
            "missing configuration",
            "missing ground",
            "missing table",
            "a configuration of brackets",
        },
        "render": {"missing table"},
        "view": {"missing table"},
        "figures": set[str](),
        "eval": {"gap in a log", "missing table"},
    }
    needed = DAMAGES.keys() - spared[command[0]]
    monkeypatch.chdir(tmp_path)
    DAMAGES[damage](root / "tiny")
    done = t6gps(*command, "--root", root, code=2 if damage in needed else 0)
    if damage in needed:
        assert done.stderr.startswith("error: ")
        assert str(root / "tiny") in done.stderr


@pytest.mark.parametrize("damage", ["missing tables", "empty tables"])
def test_lost_tables_are_no_run_that_has_just_begun(damage: str, root: Path) -> None:
    run = catalog.open_run(root, "tiny")
    assert len(package.open_run(root / "tiny").query("SELECT iteration FROM iterations")) == 3
    DAMAGES[damage](run.path)
    with pytest.raises(T6GpsError, match="is not whole"):
        package.open_run(root / "tiny").query("SELECT iteration FROM iterations")
    left_out = t6gps("query", "tin*", "SELECT count(*) FROM frames", "--root", root)
    assert "left out: run tiny is not whole" in left_out.stderr


GUARDED: list[Path] = []
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT


def refuse_writing(event: str, arguments: tuple[object, ...]) -> None:
    """What a system without permission to write does, whoever runs the tests."""
    if not GUARDED or event not in ("open", "os.mkdir", "os.rename", "os.remove"):
        return
    writes = event != "open" or (isinstance(arguments[2], int) and arguments[2] & WRITING)
    path = arguments[0]
    if writes and isinstance(path, str | os.PathLike) and Path(path).is_relative_to(GUARDED[0]):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))


sys.addaudithook(refuse_writing)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """Within, nothing in a folder can be written by Python, and nothing else has written there."""
    before = {path: path.stat().st_mtime_ns for path in (folder, *folder.rglob("*"))}
    GUARDED.append(folder)
    try:
        yield
    finally:
        GUARDED.clear()
    assert {path: path.stat().st_mtime_ns for path in (folder, *folder.rglob("*"))} == before


def test_reading_needs_no_permission_to_write(root: Path, tmp_path: Path) -> None:
    run = catalog.open_run(root, "tiny")
    status = {"state": "RUNNING", "reason": "", "pid": 1, "time_s": 0.0, "phase": "sample", "backlog": 0, "leases": 0}
    status |= {"bytes_in_flight": 0, "ready": 0, "wanted": 1, "episodes": {}, "processes": {}, "quarantined": []}
    run.pool.mkdir()
    (run.pool / "status.json").write_text(json.dumps(status | {"workers": [], "waits": []}))
    with read_only(root):
        assert "3 of 3" in t6gps("runs", "--root", root).stdout.decode()
        assert "Diagnosis" in t6gps("show", "tiny", "--root", root).stdout.decode()
        assert "STOPPED" in t6gps("status", "tiny", "--root", root).stdout.decode()
        t6gps("query", "tiny", "SELECT count(*) FROM frames", "--root", root)
        t6gps("render", "tiny", "0", "--out", tmp_path / "still.png", "--root", root)
        t6gps("view", "tiny", "0", "--out", tmp_path / "episode.rrd", "--root", root)
        t6gps("eval", "tiny", "--episodes", "2", "--serial", "--no-keep", "--root", root)
        keeps = t6gps("eval", "tiny", "--episodes", "2", "--serial", "--root", root, code=2)
        assert "cannot keep an evaluation" in keeps.stderr
        assert "--no-keep" in keeps.stderr
        refused = t6gps("train", "flat-quick", "--run", "tiny", "--resume", "--serial", *tiny_run.settings(),
                        "--root", root, code=2)  # fmt: skip
    assert "permission is missing" in refused.stderr


def test_what_a_run_was_made_with_and_is_another_now_is_a_warning(root: Path) -> None:
    path = root / "tiny" / origin.FILE
    record = json.loads(path.read_text())
    record["versions"]["numpy"] = "1.0.0"
    path.write_text(json.dumps(record))
    done = t6gps("eval", "tiny", "--episodes", "2", "--serial", "--no-keep", "--json", "--root", root)
    assert f"warning: run tiny was made with numpy 1.0.0 (now {np.__version__})" in done.stderr
    assert json.loads(done.stdout)["episodes"] == 2


@pytest.mark.slow
def test_a_root_that_looks_like_an_address_is_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    root = "runs-2026-11-27T09:30:00+00:00"
    t6gps("train", "flat-quick", "--serial", "--root", root, *tiny_run.settings(), "--set=run.iterations=1")
    assert "1 of 1" in t6gps("runs", "--root", root).stdout.decode()
    assert package.open_run(f"{root}/flat-quick").query("SELECT count(*) AS n FROM episodes")["n"].to_pylist() == [3]
    with pytest.raises(T6GpsError, match="no run"):
        package.open_run(f"{root}/none")

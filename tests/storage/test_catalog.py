from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from subprocess import PIPE
from typing import Any

import pytest

from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError


def test_a_created_run_is_found_again_with_its_configuration(tmp_path: Path) -> None:
    run = catalog.create(tmp_path / "new" / "root", "a-1_b.c", '{"seed": 1}')
    assert catalog.open_run(tmp_path / "new" / "root", "a-1_b.c") == run
    assert run.name == "a-1_b.c"
    assert run.config_path.read_text() == '{"seed": 1}'
    assert all(folder.is_dir() for folder in (run.tables, run.spool, run.checkpoints, run.figures))


@pytest.mark.parametrize("name", ["", ".", "..", ".a", "-a", "a/b", "a\\b", "a b", "é", "a\n", "a\0", "x" * 65])
def test_a_name_that_cannot_be_a_folder_everywhere_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="letters, digits"):
        catalog.create(tmp_path, name, "{}")
    assert list(tmp_path.iterdir()) == []


def test_an_existing_run_is_refused_and_left_as_it_was(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "one", "first")
    with pytest.raises(RunError, match=r"exists already.*--run.*--resume"):
        catalog.create(tmp_path, "one", "second")
    assert run.config_path.read_text() == "first"


def test_only_a_run_that_is_as_it_was_created_is_discarded(tmp_path: Path) -> None:
    runs = [catalog.create(tmp_path, name, "{}") for name in ("new", "started", "sampled")]
    runs[1].pool.mkdir()
    (runs[2].spool / "episodes").touch()
    for run in runs:
        with catalog.locked(run):
            catalog.discard_unused(run)
    assert [path.name for path in sorted(tmp_path.iterdir())] == ["sampled", "started"]


def test_a_root_that_is_a_file_or_lies_below_one_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("mine")
    for root in (file, file / "below"):
        with pytest.raises(RunError, match="writable folder"):
            catalog.create(root, "one", "{}")
    assert file.read_text() == "mine"


def test_a_root_without_write_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(RunError, match="no permission to write"):
        catalog.create(tmp_path, "one", "{}")
    assert list(tmp_path.iterdir()) == []


def test_a_root_that_the_tables_could_not_open_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="'%'"):
        catalog.create(tmp_path / "100%25", "one", "{}")


def test_a_creation_that_fails_midway_leaves_nothing_behind(tmp_path: Path, full_disk: Any) -> None:
    with full_disk(), pytest.raises(RunError, match=r"cannot create run 'one' .*File too large"):
        catalog.create(tmp_path, "one", "{}")
    assert list(tmp_path.iterdir()) == []
    catalog.create(tmp_path, "one", "{}")


CREATOR = """
import sys
from pathlib import Path
from t6gps.storage import catalog
files = {"ground/mine": sys.argv[1].encode()}
for line in sys.stdin:
    print(catalog.create(Path(line.strip()), "one", sys.argv[1], files, numbered=True).name, flush=True)
"""


def test_runs_that_processes_create_at_once_are_whole_and_each_its_creators_own(tmp_path: Path) -> None:
    processes = [
        subprocess.Popen([sys.executable, "-c", CREATOR, f'"{n}"'], stdin=PIPE, stdout=PIPE, text=True, bufsize=1)
        for n in range(8)
    ]
    with ExitStack() as ending:
        for process in processes:
            ending.enter_context(process)
            ending.callback(process.stdin.close)  # type: ignore[union-attr]
        for number in range(50):
            root = tmp_path / str(number)
            for process in processes:
                print(root, file=process.stdin)
            names = [process.stdout.readline().strip() for process in processes]  # type: ignore[union-attr]
            assert sorted(names) == ["one", *(f"one-{n}" for n in range(2, 9))]
            assert sorted(path.name for path in root.iterdir()) == sorted(names)
            for n, name in enumerate(names):
                run = catalog.open_run(root, name)
                assert run.config_path.read_text() == (run.ground / "mine").read_text() == f'"{n}"'
                assert all(folder.is_dir() for folder in (run.tables, run.spool, run.checkpoints, run.figures))


def killed_at(step: int, work: Callable[[], object]) -> bool:
    """Do the work in a child that is killed as it is about to touch the file system for the `step`-th time.

    False when the work was done before.
    """
    child = os.fork()
    if not child:
        steps = itertools.count()

        def kill(event: str, _: object) -> None:
            if event in ("open", "os.mkdir", "os.rename") and next(steps) == step:
                os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(kill)
        work()
        os._exit(0)
    return os.WIFSIGNALED(os.waitpid(child, 0)[1])


def test_a_creation_that_is_killed_anywhere_leaves_a_whole_run_or_nothing_visible_and_no_name_taken(
    tmp_path: Path,
) -> None:
    for step in itertools.count():
        root = tmp_path / str(step)
        root.mkdir()
        killed = killed_at(step, lambda root=root: catalog.create(root, "one", "{}", {"ground/mine": b"hills"}))  # type: ignore[misc]
        left = catalog.list_runs(root)
        if not left:
            catalog.create(root, "one", "{}", {"ground/mine": b"hills"})
        run = catalog.open_run(root, "one")
        assert run.config_path.read_text() == "{}"
        assert (run.ground / "mine").read_bytes() == b"hills"
        assert [path.name for path in root.iterdir() if not path.name.startswith(".")] == ["one"]
        if not killed:
            assert step > 15
            return


def test_what_killed_creations_have_left_goes_a_day_later_and_drafts_of_others_stay(tmp_path: Path) -> None:
    for name, age_s in ((".old.1f.partial", 2 * 24 * 3600), (".young.2f.partial", 60)):
        (tmp_path / name / "tables").mkdir(parents=True)
        then_s = time.time() - age_s
        os.utime(tmp_path / name, (then_s, then_s))
    (tmp_path / ".gone.3f.discarded").mkdir()
    catalog.create(tmp_path, "one", "{}")
    assert {path.name for path in tmp_path.iterdir()} == {"one", ".young.2f.partial"}


def test_a_taken_name_is_followed_by_numbers_whatever_has_taken_it(tmp_path: Path) -> None:
    (tmp_path / "one").mkdir()
    (tmp_path / "one-2").write_text("mine")
    (tmp_path / "one-3").symlink_to("nowhere")
    assert catalog.create(tmp_path, "one", "{}", numbered=True).name == "one-4"
    assert (tmp_path / "one-2").read_text() == "mine"


def test_a_root_is_known_by_its_whole_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    colon = Path("runs-2026-11-27T09:30:00+00:00")
    assert catalog.create(colon, "one", "{}").path == tmp_path / colon / "one"
    assert catalog.create(Path("~/runs"), "one", "{}").path == tmp_path / "home" / "runs" / "one"
    assert catalog.open_run(Path("home/../home/runs"), "one").path == tmp_path / "home" / "runs" / "one"
    with pytest.raises(RunError, match="leads nowhere"):
        catalog.list_runs(Path("~nobody-of-that-name/runs"))


@pytest.mark.parametrize("change", [catalog.copy, catalog.move])
def test_a_run_is_copied_and_moved_whole(change: Callable[[Run, Path, str], Run], tmp_path: Path) -> None:
    run = catalog.create(tmp_path / "a", "one", "{}", {"ground/mine": b"hills"})
    (run.tables / "frames").mkdir()
    (run.tables / "frames" / "file").write_bytes(b"rows")
    taken = catalog.create(tmp_path / "b", "taken", "first")
    with catalog.locked(run), pytest.raises(RunError, match=f"in use by process {os.getpid()}"):
        change(run, tmp_path / "b", "two")
    with pytest.raises(RunError, match="exists already"):
        change(run, tmp_path / "b", "taken")
    assert taken.config_path.read_text() == "first"
    other = change(run, tmp_path / "b", "two")
    assert [run.name for run in catalog.list_runs(tmp_path / "b")] == ["taken", "two"]
    assert (other.ground / "mine").read_bytes() == b"hills"
    assert (other.tables / "frames" / "file").read_bytes() == b"rows"
    assert run.path.exists() == (change is catalog.copy)
    with catalog.locked(other):
        assert catalog.process_of(other) == os.getpid()


def test_a_copy_that_is_killed_anywhere_is_not_seen(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "one", "{}", {"ground/mine": b"hills"})
    for step in itertools.count():
        killed = killed_at(step, lambda step=step: catalog.copy(run, tmp_path, f"copy-{step}"))  # type: ignore[misc]
        copies = [other for other in catalog.list_runs(tmp_path) if other != run]
        assert all((copy.ground / "mine").read_bytes() == b"hills" for copy in copies)
        if not killed:
            assert copies
            return


def test_a_removed_run_is_gone_and_nobody_else_can_hold_it(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "one", "{}")
    with catalog.locked(run), pytest.raises(RunError, match="in use"):
        catalog.remove(run)
    catalog.remove(run)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RunError, match="moved or removed"), catalog.locked(run):
        pass


def test_a_run_whose_configuration_is_missing_is_listed_all_the_same(tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "one", "{}")
    run.config_path.unlink()
    assert catalog.list_runs(tmp_path) == [catalog.open_run(tmp_path, "one")] == [run]


def test_runs_are_listed_by_name_and_other_folders_are_not(tmp_path: Path) -> None:
    for name in ("b", "a"):
        catalog.create(tmp_path, name, "{}")
    (tmp_path / "notes").mkdir()
    assert [run.name for run in catalog.list_runs(tmp_path)] == ["a", "b"]
    assert catalog.list_runs(tmp_path / "nowhere") == []


def test_an_unknown_run_is_answered_with_the_closest_and_with_all(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="holds no runs"):
        catalog.open_run(tmp_path, "slope")
    for name in ("flat", "slopes"):
        catalog.create(tmp_path, name, "{}")
    with pytest.raises(RunError, match=r"did you mean 'slopes'\? runs: flat, slopes"):
        catalog.open_run(tmp_path, "slope")

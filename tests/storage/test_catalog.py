from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from t6gps.storage import catalog
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


def test_a_creation_that_was_killed_midway_is_invisible_and_can_be_repeated(tmp_path: Path) -> None:
    (tmp_path / ".one.partial" / "tables").mkdir(parents=True)
    assert catalog.list_runs(tmp_path) == []
    catalog.create(tmp_path, "one", "{}")
    assert [path.name for path in tmp_path.iterdir()] == ["one"]


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

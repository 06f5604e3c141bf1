"""Laws of repairing: nothing is lost that its own files or a copy have, nothing is deleted, and losses are said."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from damages import ALTERED, DAMAGES, alter

from t6gps.storage import catalog, checkpoint, schema, tables
from t6gps.storage.care.repair import repair
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.spool import Spool


def contents(run: Run) -> dict[str, bytes]:
    """Files that are seen, but for those set aside."""
    files = (path for path in sorted(run.path.rglob("*")) if path.is_file() and not path.name.startswith("."))
    return {str(path.relative_to(run.path)): path.read_bytes() for path in files if "damaged" not in path.parts}


@pytest.mark.parametrize(
    "damage", ["a bit of a page", "gap in a log", "end of a log", "no table", "a count that is wrong", "a checkpoint"]
)
def test_a_copy_brings_back_whatever_is_damaged(worked: Run, tmp_path: Path, damage: str) -> None:
    before, copy = contents(worked), catalog.copy(worked, tmp_path, "copy")
    DAMAGES[damage][1](worked)
    done = repair(worked, copy, verify)
    assert not done.left and done.sentences and verify(worked) == []
    rows = {name: tables.read(worked, name) for name in schema.TABLES}
    assert rows == {name: tables.read(copy, name) for name in schema.TABLES}
    if "gap" in damage or "bit" in damage:
        assert contents(worked) == before


def test_a_log_is_built_anew_from_its_files_and_the_old_one_kept(worked: Run) -> None:
    rows = {name: tables.read(worked, name) for name in schema.TABLES}
    torn = worked.tables / "frames" / "_delta_log" / f"{2:020d}.json"
    os.truncate(torn, 60)
    done = repair(worked, None, verify)
    assert done.sentences == ["tables/frames/_delta_log is built anew from 3 files"]
    assert (done.left, verify(worked)) == ([], [])
    assert {name: tables.read(worked, name) for name in schema.TABLES} == rows
    assert (worked.path / "damaged" / torn.relative_to(worked.path)).stat().st_size == 60


@pytest.mark.parametrize(
    "damage", ["no tables", "empty tables", "a file named tables", "a file named as a table", "a file named as a log"]
)
def test_lost_tables_are_repaired_by_a_copy_and_else_made_anew(worked: Run, tmp_path: Path, damage: str) -> None:
    copy, second = (catalog.copy(worked, tmp_path, name) for name in ("copy", "second"))
    part, plant = DAMAGES[damage]
    for run in (worked, second):
        plant(run)
        with pytest.raises(DataError, match=f"table {part} .*cannot be read"):
            tables.read(run, "frames" if part == "episodes" else part)
    assert repair(worked, copy, verify).left == []
    assert {name: tables.read(worked, name) for name in schema.TABLES} == {
        name: tables.read(copy, name) for name in schema.TABLES
    }
    done = repair(second, None, verify)
    assert (done.left, verify(second)) == ([], [])
    assert tables.committed_iterations(second) == (3 if "log" in damage else 0)


def test_what_only_looks_like_a_part_of_a_run_is_none(worked: Run, make_episode: Any) -> None:
    for folder in (worked.checkpoints, worked.spool):
        for name in ("iteration-000010.bak", "iteration-abc", "iteration-000010 (copy)"):
            (folder / name).mkdir()
            (folder / name / "episode-000000000001.arrow").write_text("torn")
    log = worked.tables / "frames" / "_delta_log"
    shutil.copy(log / f"{1:020d}.json", log / f"{1:020d} (copy).json")
    assert verify(worked) == []
    os.truncate(worked.tables / "models" / "iteration-000001.parquet", 100)
    assert repair(worked, None, verify).left == []
    assert list(checkpoint.kept(worked.checkpoints)) == [1]
    assert (worked.checkpoints / "iteration-abc").is_dir()


@pytest.mark.parametrize("name", ALTERED)
def test_a_commit_that_was_altered_costs_nothing_where_its_file_is_as_it_was(worked: Run, name: str) -> None:
    rows = {name: tables.read(worked, name) for name in schema.TABLES}
    alter(worked, "models" if name != "range" else "episodes", 1, ALTERED[name])
    done = repair(worked, None, verify)
    assert [sentence.split("/")[-1] for sentence in done.sentences] == ["_delta_log is built anew from 3 files"]
    assert (done.left, verify(worked)) == ([], [])
    assert {name: tables.read(worked, name) for name in schema.TABLES} == rows


def test_a_copy_that_has_less_costs_no_iteration(worked: Run, tmp_path: Path, iterate: Any) -> None:
    copy = catalog.copy(worked, tmp_path, "copy")
    iterate(worked, 3)
    rows = {name: tables.read(worked, name) for name in schema.TABLES}
    alter(worked, "models", 1, next(iter(ALTERED.values())))
    assert repair(worked, copy, verify).left == []
    assert {name: tables.read(worked, name) for name in schema.TABLES} == rows


def test_what_cannot_be_mended_is_set_aside_and_comes_again(worked: Run, iterate: Any, evaluate: Any) -> None:
    frames = tables.read(worked, "frames")
    os.truncate(worked.tables / "models" / "iteration-000001.parquet", 100)
    done = repair(worked, None, verify)
    assert [sentence.split(" are ")[0] for sentence in done.sentences] == [
        "iterations from 1 on",
        "evaluations from 1 on",
    ]
    assert (done.left, verify(worked)) == ([], [])
    assert tables.committed_iterations(worked) == 1
    assert list(checkpoint.kept(worked.checkpoints)) == [1]
    for name in ("models", "frames", "episodes"):
        assert (worked.path / "damaged" / "tables" / name / "iteration-000002.parquet").exists()
    iterate(worked, 1)
    iterate(worked, 2)
    assert tables.read(worked, "frames") == frames
    assert verify(worked) == []


def test_a_file_of_frames_is_written_anew_from_the_spool(worked: Run, make_episode: Any) -> None:
    for index in range(3):
        Spool(worked.spool, 2).append(make_episode(200 + index, 2))
    file = worked.tables / "frames" / "iteration-000002.parquet"
    whole = file.read_bytes()
    os.truncate(file, 100)
    assert repair(worked, None, verify).sentences == [
        "tables/frames/iteration-000002.parquet is written anew from the spool"
    ]
    assert file.read_bytes() == whole


def test_torn_states_and_episodes_are_set_aside(worked: Run, make_episode: Any) -> None:
    Spool(worked.spool, 3).append(make_episode(300, 3))
    for damage in ("a checkpoint", "a spooled episode"):
        DAMAGES[damage][1](worked)
    done = repair(worked, None, verify)
    assert [sentence.split(":")[0].rsplit(" is ", 1)[0] for sentence in done.sentences] == [
        "checkpoints/iteration-000003",
        "spool/iteration-000003/episode-000000000300.arrow",
    ]
    assert [sentence.split("damaged/: ")[1] for sentence in done.sentences] == [
        "checkpoints/iteration-000002 serves when the run is resumed",
        "its episode is sampled again when the run is resumed",
    ]
    assert verify(worked) == []


def test_what_is_said_of_what_is_set_aside_is_so(worked: Run, make_episode: Any) -> None:
    Spool(worked.spool, 1).append(make_episode(100, 1))
    os.truncate(Spool(worked.spool, 1).path(100), 99)
    assert repair(worked, None, verify).sentences == [
        "spool/iteration-000001/episode-000000000100.arrow is set aside in damaged/: "
        "its iteration is finished, and nothing needs it"
    ]
    for state in checkpoint.kept(worked.checkpoints).values():
        (state / "DONE").unlink()
    done = repair(worked, None, verify)
    assert checkpoint.load_latest(worked.checkpoints) is None
    assert {sentence.split("damaged/: ")[1] for sentence in done.sentences} == {
        "there is no other one, so that a run that is resumed begins anew, to the same bytes"
    }


def test_a_sound_run_a_run_in_use_and_the_copy_of_another_are_left_as_they_are(worked: Run, tmp_path: Path) -> None:
    assert repair(worked, None, verify).sentences == []
    other = catalog.create(tmp_path, "other", '{"run": 1}')
    DAMAGES["half a file"][1](worked)
    before = contents(worked)
    with catalog.locked(worked), pytest.raises(RunError, match="in use"):
        repair(worked, None, verify)
    with pytest.raises(RunError, match="is no copy of this run"):
        repair(worked, other, verify)
    assert contents(worked) == before
    assert sorted(path.name for path in worked.path.parent.iterdir()) == ["worked"]

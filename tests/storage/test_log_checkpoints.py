"""Laws of the checkpoints of tables' logs: they say what the commits say, and nothing is lost with them."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import synthetic
from damages import ALTERED, alter, flip
from deltalake import DeltaTable
from run_digest import digests

from t6gps.storage import durable, schema, tables
from t6gps.storage.care import delta_files
from t6gps.storage.care.repair import repair
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints, log

ITERATIONS_N = checkpoints.EVERY_N + 3


@pytest.fixture(scope="module")
def shelf(tmp_path_factory: pytest.TempPathFactory) -> Run:
    """A run that is long enough for a checkpoint of each log, for all tests."""
    return synthetic.made(tmp_path_factory.mktemp("shelf"), ITERATIONS_N)


@pytest.fixture
def run(shelf: Run, tmp_path: Path) -> Run:
    """The same run, of this test's own."""
    return Run(Path(shutil.copytree(shelf.path, tmp_path / shelf.name)))


def newest(run: Run, table: str) -> Path:
    """The newest checkpoint of a table's log."""
    return checkpoints.kept(run.tables / table / "_delta_log")[-1]


def test_every_tenth_commit_has_a_checkpoint_and_nothing_else_is_left(run: Run) -> None:
    for table in schema.OF_ITERATIONS:
        folder = run.tables / table / "_delta_log"
        commits = [f"{version:020d}.json" for version in range(ITERATIONS_N + 1)]
        assert {path.name for path in folder.iterdir()} == {*commits, f"{checkpoints.EVERY_N:020d}.checkpoint.parquet"}
    assert {path.name for path in run.tables.iterdir()} == set(schema.OF_ITERATIONS)
    assert verify(run) == []


def test_readers_need_no_commit_before_a_checkpoint_and_verifying_misses_each(run: Run) -> None:
    before = digests(run.path)
    for table in schema.OF_ITERATIONS:
        for version in range(checkpoints.EVERY_N):
            (run.tables / table / "_delta_log" / f"{version:020d}.json").unlink()
    assert digests(run.path) == before
    frames = DeltaTable(str(run.tables / "frames"))
    assert frames.to_pyarrow_table().num_rows == ITERATIONS_N * synthetic.FRAMES_N
    missing = {(fault.part, Path(fault.place).name) for fault in verify(run) if "commit is missing" in fault.what}
    expected = (f"{version:020d}.json" for version in range(checkpoints.EVERY_N))
    assert {name for part, name in missing if part == "frames"} == set(expected)
    assert {part for part, _ in missing} == set(schema.OF_ITERATIONS)


def test_a_run_without_checkpoints_goes_on(run: Run) -> None:
    before = digests(run.path)
    for table in schema.OF_ITERATIONS:
        newest(run, table).unlink()
    assert (digests(run.path), verify(run)) == (before, [])
    synthetic.commit(run, ITERATIONS_N)
    assert tables.committed_iterations(run) == ITERATIONS_N + 1


def test_what_a_killed_process_has_left_of_a_checkpoint_is_of_no_harm(run: Run) -> None:
    draft = durable.hidden(run.tables / "frames")
    (draft / "_delta_log").mkdir(parents=True)
    (draft / "_delta_log" / f"{0:020d}.json").write_text("torn")
    newest(run, "frames").unlink()
    assert verify(run) == []
    checkpoints.write(run.tables / "frames")
    assert checkpoints.version(newest(run, "frames")) == ITERATIONS_N
    assert not draft.exists()
    assert verify(run) == []


def of_fewer_commits(run: Run) -> None:
    """Give a checkpoint the content of one of an earlier commit."""
    other = run.path.with_name("other")
    shutil.copytree(run.tables / "frames" / "_delta_log", other / "_delta_log")
    for path in (other / "_delta_log").iterdir():
        if path.name >= f"{checkpoints.EVERY_N - 2:020d}":
            path.unlink()
    checkpoints.write(other)
    shutil.copy(checkpoints.kept(other / "_delta_log")[-1], newest(run, "frames"))


UNREADABLE, CONTRADICTED = r"one cannot be read \(.+\), and the log has all commits", "they contradict the commits"
DAMAGES: dict[str, tuple[Callable[[Run], object], str, bool]] = {
    "half of it": (lambda run: os.truncate(newest(run, "frames"), 400), UNREADABLE, False),
    "nothing of it": (lambda run: os.truncate(newest(run, "frames"), 0), UNREADABLE, False),
    "one of fewer commits": (of_fewer_commits, f"{CONTRADICTED}, which fit the files", False),
    **{
        f"a commit's {name}": (lambda run, change=change: alter(run, "frames", 4, change), CONTRADICTED, True)
        for name, change in ALTERED.items()
        if name != "rows left out"  # that is said of the commit itself
    },
}
"""What each does, what is said of the checkpoint, and whether the log is built anew: it is where commits are wrong."""


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_checkpoint_that_is_damaged_or_contradicted_is_set_aside_with_nothing_lost(run: Run, damage: str) -> None:
    before, (plant, why, anew) = digests(run.path), DAMAGES[damage]
    plant(run)
    place = newest(run, "frames").relative_to(run.path)
    assert {(fault.part, fault.place) for fault in verify(run) if fault.part == "frames"} == {("frames", str(place))}
    done = repair(run, None, verify)
    assert (done.left, verify(run), digests(run.path)) == ([], [], before)
    said, *more = done.sentences
    assert re.fullmatch(f"checkpoints of {place.parent} are set aside in damaged/: {why}", said)
    assert more == ([f"{place.parent} is built anew from {ITERATIONS_N} files"] if anew else [])
    assert (run.path / "damaged" / place).exists()
    synthetic.commit(run, ITERATIONS_N)
    assert verify(run) == []


def test_a_changed_bit_of_a_checkpoint_is_found_or_changes_no_answer(run: Run) -> None:
    before, file = tables.files(run, ["episodes"]), newest(run, "episodes")
    whole = file.read_bytes()
    for place in range(0, len(whole), len(whole) // 150):
        flip(file, place)
        if not delta_files.opened(run, "episodes").faults:
            assert tables.files(run, ["episodes"]) == before, place
            assert log.committed(log.opened(run, "episodes")) == ITERATIONS_N, place
        file.write_bytes(whole)


def test_iterations_that_are_set_aside_are_in_no_checkpoint(run: Run) -> None:
    before, kept_n = digests(run.path), checkpoints.EVERY_N - 3
    os.truncate(run.tables / "models" / f"iteration-{kept_n:06d}.parquet", 100)
    done = repair(run, None, verify)
    assert (done.left, verify(run)) == ([], [])
    assert tables.committed_iterations(run) == kept_n
    for iteration in range(kept_n, ITERATIONS_N):
        synthetic.commit(run, iteration)
    assert verify(run) == []
    assert tables.committed_iterations(run) == ITERATIONS_N
    names = ("frames", "episodes", "policies")
    assert [digests(run.path)[name] for name in names] == [before[name] for name in names]


def test_a_log_with_a_gap_is_built_anew_with_its_checkpoints(run: Run) -> None:
    before = digests(run.path)
    (run.tables / "classes" / "_delta_log" / f"{4:020d}.json").unlink()
    done = repair(run, None, verify)
    assert done.sentences == [f"tables/classes/_delta_log is built anew from {ITERATIONS_N} files"]
    assert (done.left, verify(run), digests(run.path)) == ([], [], before)
    assert checkpoints.version(newest(run, "classes")) == checkpoints.EVERY_N

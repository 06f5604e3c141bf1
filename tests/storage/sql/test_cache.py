"""Laws of the cache below a root: answers are those of the tables, whatever has changed, and whatever became of it."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from t6gps.storage import catalog, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import evaluations, parquet
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode
from t6gps.storage.sql import cache
from t6gps.storage.sql.query import Question, query

DEADLINE_S = 240.0
TABLES = ("frames", "episodes", "iterations", "evaluations")
COSTS = "SELECT run, sum(cost) AS cost, count(*) AS n FROM episodes GROUP BY run ORDER BY run"

Answers = dict[str, object]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return tmp_path / "runs"


@pytest.fixture
def make(root: Path, commit: Any) -> Callable[..., None]:
    """make(names) creates runs of two iterations, and waits until the cache has them all."""
    first = catalog.create(root, "first", "{}")
    for iteration in range(2):
        commit(first, iteration)

    def settled(*names: str) -> None:
        for name in names:
            shutil.copytree(first.path, root / name)
        deadline = time.monotonic() + DEADLINE_S
        while not all(kept(run) for run in catalog.list_runs(root)):
            assert time.monotonic() < deadline, "the cache does not take runs that nobody changes"
            time.sleep(0.1)  # the file system's clock brings it about: there is nothing to wait on but that
            ask(root)

    return settled


def kept(run: Run) -> list[Path]:
    """The entries of a run."""
    return sorted(run.cache.glob("[!.]*"))


def ask(root: Path) -> Answers:
    """What there is to say of each run below a root: its rows, files and newest iteration, or what is damaged."""
    found = Answers()
    for run in catalog.list_runs(root):
        try:
            whole, files = cache.whole(run), cache.files(run, TABLES)
            rows = {table: parquet.rows_of_runs(table, {run.name: files[table]}).to_table() for table in TABLES}
            models = [Path(path).name for path in whole.files["models"].paths]
            found[run.name] = (whole.done, dict(whole.newest), models, rows)
        except DataError as error:
            found[run.name] = str(error)
    return found


def without_cache(root: Path) -> Answers:
    """The same from the tables alone."""
    shutil.rmtree(root / ".cache")
    (root / ".cache").touch()  # so that nothing is kept
    try:
        return ask(root)
    finally:
        (root / ".cache").unlink()


def rewrite(path: Path, change: Callable[[bytes], bytes]) -> None:
    """Change a file in place, to the same size and with the time that it had."""
    before, content = path.stat(), path.read_bytes()
    path.write_bytes(change(content))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size


def with_other_costs(file: Path) -> bytes:
    """The content of a file of `iterations` with other costs, of the same size."""
    rows, other = pq.read_table(file), file.with_name(".other")
    column = rows.column_names.index("cost")
    for cost in range(1000):
        costs = pa.array([cost / 7] * rows.num_rows)
        parquet.write(other, schema.ITERATIONS, [rows.set_column(column, schema.ITERATIONS.field("cost"), costs)])
        content = other.read_bytes()
        other.unlink()
        if len(content) == file.stat().st_size:
            return content
    raise AssertionError("no such content")


def evaluate(run: Run, episode: Episode) -> None:
    """Keep an evaluation of one episode."""
    row = {field.name: "text" if pa.types.is_string(field.type) else 1 for field in schema.EVALUATIONS}
    evaluations.commit(run, {name: value for name, value in row.items() if name != "evaluation_id"}, [episode])


def test_answers_are_those_of_the_tables_after_every_change(
    root: Path, make: Any, commit: Any, commit_cut_off: Any, make_episode: Callable[..., Episode]
) -> None:
    changes = "committed, cut-off, evaluated, moved, removed, copied, rewritten, lacking, shorter, log-gap"
    names = changes.split(", ")
    make(*names)
    runs = {name: catalog.open_run(root, name) for name in names}
    before = ask(root)
    assert before == without_cache(root)
    commit(runs["committed"], 2)
    commit_cut_off(runs["cut-off"], 2, "frames classes iterations models")
    evaluate(runs["evaluated"], make_episode(0, 0))
    catalog.remove(runs["removed"])
    catalog.move(runs["moved"], root, "removed")
    commit(runs["copied"], 2)
    catalog.copy(runs["copied"], root, "moved")
    newest = runs["rewritten"].tables / "iterations" / "iteration-000001.parquet"
    content = with_other_costs(newest)
    rewrite(newest, lambda _: content)
    (runs["lacking"].tables / "frames" / "iteration-000001.parquet").unlink()
    os.truncate(runs["shorter"].tables / "iterations" / "iteration-000001.parquet", 100)
    (runs["log-gap"].tables / "episodes" / "_delta_log" / f"{1:020d}.json").unlink()
    after = ask(root)
    assert after == without_cache(root)
    assert {name for name in before if after[name] != before[name]} == set(names) - {"removed"}


def test_a_run_whose_files_could_change_again_within_a_step_of_the_clock_is_not_kept(root: Path, make: Any) -> None:
    make()
    run = catalog.open_run(root, "first")
    (entry,) = kept(run)
    newest = run.tables / "episodes" / "iteration-000001.parquet"
    os.utime(newest, (time.time() + 3600, time.time() + 3600))
    assert cache.whole(run).done == 2
    assert kept(run) == [entry], "of the run as it was"


def test_entries_that_are_damaged_or_deleted_in_part_are_made_anew(root: Path, make: Any) -> None:
    make("second", "third")
    runs = catalog.list_runs(root)
    answer = query(Question(runs, COSTS))
    (torn,), (lacking,) = kept(runs[0]), kept(runs[1])
    (torn / "episodes.parquet").write_bytes(b"torn")
    (lacking / "episodes.parquet").unlink()
    assert query(Question(runs, COSTS)).equals(answer)
    assert answer.num_rows == 3
    assert not cache.forget_torn(runs)
    assert all(kept(run) for run in runs)


def test_many_may_ask_while_somebody_deletes_the_cache(root: Path, make: Any) -> None:
    make()
    run = catalog.open_run(root, "first")
    whole = cache.whole(run)
    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(cache.whole, run) for _ in range(40)]
        while not all(answer.done() for answer in asked):
            shutil.rmtree(run.cache, ignore_errors=True)
        for answer in asked:
            assert (answer.result().done, answer.result().newest) == (whole.done, whole.newest)

"""Laws of a store that this program reads: it gives what is stored, lazily, also to processes of a DataLoader."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from loopback import commit
from torch.utils.data import DataLoader

import t6gps
from t6gps.service import config as configuration
from t6gps.storage import catalog, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode


@pytest.fixture
def runs(tmp_path: Path, make_episode: Callable[..., Episode]) -> list[Run]:
    """Runs of one and of two iterations."""
    found = [
        catalog.create(tmp_path / "runs", name, configuration.load("flat-quick").to_json()) for name in ("one", "two")
    ]
    for iterations_n, run in enumerate(found, start=1):
        for iteration in range(iterations_n):
            commit(run, iteration, make_episode)
    return found


@pytest.fixture
def store(runs: list[Run]) -> t6gps.Store:
    return t6gps.open_store(runs[0].path.parent)


def test_a_store_has_its_runs_and_each_has_its_episodes(store: t6gps.Store, runs: list[Run]) -> None:
    assert [run.name for run in store.runs()] == ["one", "two"]
    number = int(tables.read(runs[1], "episodes")["episode_id"][-1].as_py())
    made = tables.episode(runs[1], number)
    episode = store.run("two").episode(number)
    assert episode.frames.equals(made.frames)
    assert episode.summary == made.summary.to_pylist()[0]
    np.testing.assert_array_equal(episode["nodes"].reshape(-1, 36), schema.array(made.frames, "nodes"))
    some = store.run("two").episode(number, ["action", "step"])
    assert list(some) == ["action", "step"]
    np.testing.assert_array_equal(some["action"], episode["action"])


def test_sql_asks_all_runs_those_of_a_pattern_or_one(store: t6gps.Store) -> None:
    sql = "SELECT run, count(DISTINCT iteration) AS n FROM episodes WHERE iteration >= $least GROUP BY run ORDER BY run"
    assert store.sql(sql, least=0).arrow().to_pylist() == [{"run": "one", "n": 1}, {"run": "two", "n": 2}]
    assert store.sql(sql, runs="t*", least=1).numpy()["n"].tolist() == [1]
    assert store.run("two").sql(sql, least=0).pandas()["n"].tolist() == [2]
    assert store.run("one").sql("SELECT run FROM runs").polars()["run"].to_list() == ["one"]


def test_a_damaged_run_is_left_out_of_many_with_a_warning_and_refused_alone(
    store: t6gps.Store, runs: list[Run], caplog: pytest.LogCaptureFixture
) -> None:
    sql = "SELECT DISTINCT run FROM frames"
    assert len(store.sql(sql).arrow()) == 2
    next((runs[0].tables / "frames").glob("*.parquet")).unlink()
    assert store.sql(sql).arrow().to_pylist() == [{"run": "two"}]
    assert "left out: run one is not whole" in caplog.text
    with pytest.raises(DataError, match="run one is not whole"):
        store.run("one").sql(sql).arrow()


def test_nothing_is_asked_before_rows_are(store: t6gps.Store) -> None:
    wrong = store.sql("SELECT speeed FROM frames")
    with pytest.raises(t6gps.QueryError, match='"speeed"'):
        wrong.arrow()


def test_what_is_not_there_is_refused_in_words(store: t6gps.Store, tmp_path: Path) -> None:
    with pytest.raises(t6gps.RunError, match=r"there is no run 'twoo'.*did you mean 'two'"):
        store.run("twoo")
    with pytest.raises(t6gps.RunError, match="no folder"):
        t6gps.open_store(tmp_path / "none")
    with pytest.raises(DataError, match="no episode 99999"):
        store.run("one").episode(99999)
    with pytest.raises(DataError, match="no column 'speed'"):
        store.run("one").episode(0, ["speed"])


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "forkserver"])
def test_a_data_loader_gives_the_same_batches_with_workers_as_without(store: t6gps.Store, context: str) -> None:
    windows = pickle.loads(pickle.dumps(store)).windows(["nodes", "action", "step"], length=3, where="face < 18")
    assert len(store.run("two").windows(["nodes"], length=3)) < len(store.windows(["nodes"], length=3))
    alone, shared = (
        list(
            DataLoader(
                windows, batch_size=4, num_workers=workers_n, multiprocessing_context=context if workers_n else None
            )
        )
        for workers_n in (0, 2)
    )
    assert len(alone) == len(shared) == -(-len(windows) // 4)
    assert tuple(alone[0]["nodes"].shape) == (4, 3, 12, 3)
    for one, other in zip(alone, shared, strict=True):
        assert all((one[name] == other[name]).all() for name in ("nodes", "action", "step"))

"""Laws of windows: each is rows of one episode in a row, all are there, wherever and in which order they are read."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.errors import ConfigError, DataError, QueryError
from t6gps.storage.records import Episode
from t6gps.storage.sql import inprocess
from t6gps.storage.sql.query import Question
from t6gps.storage.store.result import Result
from t6gps.storage.store.windows import Windows, windows

EPISODES_N, LENGTH = 12, 3


@pytest.fixture
def episodes(run: Run, make_episode: Callable[..., Episode], learn: Any) -> list[Episode]:
    """Two iterations of episodes of several lengths, in more than one row group."""
    found = []
    for iteration in range(2):
        new = [make_episode(100 * iteration + k, iteration, 4 + k % 3) for k in range(EPISODES_N)]
        iterations.commit(run, iteration, iter(new), learn(iteration))
        found += new
    return found


def of(run: Run, *others: Run, **options: Any) -> Windows:
    runs = {found.name: found for found in (run, *others)}

    def ask(sql: str, parameters: Mapping[str, int]) -> Result:
        return Result(lambda: inprocess.InProcess().answered(Question(list(runs.values()), sql, parameters)))

    return windows(ask, runs.__getitem__, **{"columns": ["step", "nodes", "entry_edge"], "length": LENGTH, **options})


def expected(episodes: list[Episode], column: str, last: int = 0) -> list[bytes]:
    """The bytes of all windows of a vector column, and rows at an episode's end that are left out."""
    found = []
    for episode in episodes:
        rows = np.array(episode.frames[column].to_pylist()[: episode.frames.num_rows - last], np.float32)
        found += [rows[first : first + LENGTH].tobytes() for first in range(len(rows) - LENGTH + 1)]
    return found


def test_every_window_is_there_once_bit_for_bit(run: Run, episodes: list[Episode]) -> None:
    found = of(run)
    assert len(found) == len(expected(episodes, "nodes")) == sum(e.frames.num_rows - LENGTH + 1 for e in episodes)
    assert [item["nodes"].tobytes() for item in found] == expected(episodes, "nodes")
    assert all(np.array_equal(np.diff(item["step"]), np.ones(LENGTH - 1)) for item in found)
    assert {(item["nodes"].shape, item["entry_edge"].dtype) for item in found} == {((LENGTH, 12, 3), np.dtype(float))}


def test_no_window_has_a_state_without_its_action(run: Run, episodes: list[Episode]) -> None:
    for where in (None, "true"):
        found = of(run, columns=["action"], where=where)
        assert [item["action"].tobytes() for item in found] == expected(episodes, "action", last=1)


def test_each_row_of_a_window_meets_the_condition(run: Run, episodes: list[Episode]) -> None:
    found = of(run, columns=["episode_id", "step", "face"], where="face < 14 AND episodes.iteration = 1 -- a remark")
    items = list(found)
    assert items
    assert all((item["face"] < 14).all() and (item["episode_id"] >= 100).all() for item in items)
    brute = 0
    for episode in episodes[EPISODES_N:]:
        good = np.array(episode.frames["face"].to_pylist()) < 14
        brute += sum(good[first : first + LENGTH].all() for first in range(len(good) - LENGTH + 1))
    assert len(found) == brute
    assert len(of(run, where="false")) == 0


def test_items_are_the_same_in_any_order_in_batches_and_with_little_room(run: Run, episodes: list[Episode]) -> None:
    found = of(run)
    inorder = [item["nodes"].tobytes() for item in found]
    order = np.random.default_rng(3).permutation(len(found))
    small = pickle.loads(pickle.dumps(of(run, cache_bytes=1)))
    for chosen in (found, small):
        batch = chosen.__getitems__(order)
        assert [item["nodes"].tobytes() for item in batch] == [inorder[index] for index in order]
    assert found[-1]["nodes"].tobytes() == inorder[-1]
    found[0]["nodes"][:] = 0
    assert found[0]["nodes"].tobytes() == inorder[0], "an item belongs to who asked"
    with pytest.raises(IndexError, match=f"there are {len(found)} windows"):
        found[len(found)]


def test_windows_of_many_runs_come_run_by_run(run: Run, episodes: list[Episode]) -> None:
    other = catalog.copy(run, run.path.parent, "another")
    found = of(run, other)
    alone = [item["nodes"].tobytes() for item in of(run)]
    assert [item["nodes"].tobytes() for item in found] == alone + alone


@pytest.mark.parametrize(
    ("options", "error", "words"),
    [
        ({"length": 0}, ConfigError, "length >= 1, found 0"),
        ({"length": 2.5}, ConfigError, "length >= 1, found 2.5"),
        ({"columns": ["speed"]}, DataError, "no column 'speed'"),
        ({"where": "speeed > 1"}, QueryError, '"speeed"'),
        ({"where": "cost < 1"}, QueryError, r'Ambiguous.*episodes\."cost"'),
        ({"where": "1; DROP TABLE frames"}, QueryError, "error"),
    ],
)
def test_what_cannot_be_is_refused_in_words(
    run: Run, episodes: list[Episode], options: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        of(run, **options)


def test_a_file_that_is_damaged_meanwhile_is_named(run: Run, episodes: list[Episode]) -> None:
    found = of(run)
    file = run.tables / "frames" / "iteration-000001.parquet"
    file.write_bytes(file.read_bytes()[:-50])
    assert found[0]["nodes"].shape == (LENGTH, 12, 3)
    with pytest.raises(DataError, match="run trial is not whole: table frames"):
        found[len(found) - 1]

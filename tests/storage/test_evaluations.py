"""Laws of evaluations in a run's tables: whole, numbered in turn, each once, whatever was cut off."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from t6gps.storage import fields, schema, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import evaluations
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode
from t6gps.storage.sql.query import Question, query

ORDER = ["evaluation_frames", "evaluation_episodes", "evaluations"]


def _row(**changed: object) -> dict[str, object]:
    names = [field for field in schema.EVALUATIONS if field.name != "evaluation_id"]
    row: dict[str, object] = {field.name: "x" if field.type == pa.string() else 1 for field in names}
    return row | changed


@pytest.fixture
def commit(make_episode: Callable[..., Episode]) -> Callable[[Run, int], tuple[int, list[Episode]]]:
    """Commit an evaluation of three synthetic episodes of a policy; its number and the episodes."""

    def commit_three(run: Run, version: int) -> tuple[int, list[Episode]]:
        episodes = [make_episode(index, version) for index in range(3)]
        return evaluations.commit(run, _row(policy_version=version), iter(episodes)), episodes

    return commit_three


def test_episodes_of_evaluations_are_kept_bit_for_bit(run: Run, commit: Any, bits: Any) -> None:
    numbers, given = zip(*(commit(run, version) for version in (4, 4, 7)), strict=True)
    assert numbers == (0, 1, 2)
    for number, episodes in zip(numbers, given, strict=True):
        for index, episode in enumerate(episodes):
            kept = tables.episode(run, index, number)
            assert bits(kept.frames.drop_columns("evaluation_id")) == bits(episode.frames.drop_columns("iteration"))
            assert bits(kept.summary.drop_columns("evaluation_id")) == bits(episode.summary.drop_columns("iteration"))
    for name in schema.OF_EVALUATIONS:
        fields.check(tables.read(run, name), schema.TABLES[name], "read")
    counted = query(
        Question([run], "SELECT evaluation_id, count(*) AS n FROM evaluation_frames GROUP BY ALL ORDER BY ALL")
    )
    assert counted.to_pylist() == [{"evaluation_id": number, "n": 18} for number in numbers]


@pytest.mark.parametrize("committed_n", range(3))
def test_an_evaluation_that_a_crash_cut_off_is_not_seen_and_its_number_not_used_again(
    run: Run, commit: Any, tmp_path: Path, committed_n: int
) -> None:
    commit(run, 1)
    ahead = Run(tmp_path / "ahead")
    shutil.copytree(run.path, ahead.path)
    commit(ahead, 2)
    for table in ORDER[:committed_n]:
        shutil.copytree(ahead.tables / table, run.tables / table, dirs_exist_ok=True)
    assert [set(tables.read(run, name)["evaluation_id"].to_pylist()) for name in ORDER] == [{0}] * 3
    assert commit(run, 3)[0] == (2 if committed_n else 1)
    versions = tables.read(run, "evaluations", ["policy_version"]).to_pylist()
    assert [row["policy_version"] for row in versions] == [1, 3]
    tables.files(run)


def test_those_who_evaluate_at_once_number_in_turn(run: Run, make_episode: Any) -> None:
    def commit_one(_: int) -> int:
        return evaluations.commit(run, _row(), iter([make_episode(0, 0)]))

    with ThreadPoolExecutor(4) as threads:
        numbers = list(threads.map(commit_one, range(12)))
    assert sorted(numbers) == tables.read(run, "evaluations")["evaluation_id"].to_pylist() == list(range(12))


def test_data_that_break_their_schema_are_refused_and_nothing_is_kept(run: Run, make_episode: Any) -> None:
    for row, episodes, reason in (
        (_row(cost=float("nan")), [make_episode(0, 0)], "not finite"),
        (_row(), [], "has no episodes"),
        (_row(), [make_episode(1, 0), make_episode(0, 0)], "ascending"),
    ):
        with pytest.raises(DataError, match=reason):
            evaluations.commit(run, row, iter(episodes))
    assert not tables.read(run, "evaluations").num_rows


@pytest.mark.parametrize("table", ORDER)
def test_damage_is_one_clear_error(run: Run, commit: Any, table: str) -> None:
    commit(run, 0)
    (run.tables / table / "evaluation-000000.parquet").unlink()
    with pytest.raises(DataError, match=f"run trial is not whole: table {table} in .*restore"):
        tables.files(run)


def test_an_unknown_evaluation_or_episode_is_answered_with_those_that_exist(run: Run, commit: Any) -> None:
    commit(run, 0)
    with pytest.raises(DataError, match=r"3 episodes lie in 0 \.\. 2"):
        tables.episode(run, 3, 0)
    with pytest.raises(DataError, match="there is no such evaluation"):
        tables.episode(run, 0, 1)

"""`t6gps bench storage` with little data: every figure is there, and a store that is not installed has none."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from t6gps.service.bench import registry
from t6gps.service.bench.stores import contestants, material, storage
from t6gps.storage import spool
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import Episode

SMALL = storage.Sizes(rounds=1, episodes_n=2, growth_n=5, runs_n=2, run_iterations_n=1)


@pytest.mark.slow
def test_every_store_and_question_is_measured() -> None:
    lines: list[str] = []
    figures = storage.measure(SMALL, lines.append)
    for store in contestants.STORES:
        values = [figures[f"append_{store}_s"], figures[f"size_{store}"], figures[f"episode_{store}_ms"]]
        assert all(value is not None and value > 0 for value in values) == (store in contestants.installed())
    assert figures["append_rows_n"] == 502
    rest = {"sql_duckdb_ms", "windows_ratio", "append_growth", "runs_s", "runs_first_s", "mean_over_runs_s"}
    assert rest | {f"sql_{way}_ratio" for way in storage.WAYS} <= figures.keys()
    assert figures["size_t6gps"] < min(figures[f"size_{store}"] for store in contestants.installed()[1:])
    assert any("2 runs of 1 iterations" in line for line in lines)


def test_fewer_rounds_mean_less_data() -> None:
    whole, quick = storage.Sizes(), storage.Sizes.within(1)
    assert (whole.episodes_n, whole.growth_n, whole.runs_n, whole.run_iterations_n) == (300, 50, 500, 10)
    assert (quick.episodes_n, quick.growth_n, quick.runs_n, quick.run_iterations_n) == (60, 10, 100, 10)
    assert storage.Sizes.within(9) == storage.Sizes(rounds=9)


def test_renumbered_and_shortened_episodes_follow_the_schema(make_episode: Callable[..., Episode]) -> None:
    episodes = [make_episode(number, 0) for number in range(2)]
    for place, episode in enumerate(material.short(material.of_iteration(episodes, 3), 4)):
        checked = spool.checked(episode, 3)
        assert checked.episode_id == 6 + place
        assert checked.frames.num_rows == 4


def test_raw_bytes_are_those_of_the_numbers(make_episode: Callable[..., Episode]) -> None:
    episode = make_episode(0, 0)
    vectors, doubles, integers, bytes_n = 310, 13, 4, 5
    of_row = 4 * vectors + 8 * doubles + 8 + 4 * integers + bytes_n
    assert material.raw_bytes([episode, episode]) == 2 * episode.frames.num_rows * of_row


@pytest.mark.parametrize(
    ("name", "sizes", "words"),
    [
        ("storage", {"rounds": 0}, "rounds >= 1, found 0"),
        ("storage", {"seconds": 1.0}, "bench storage has no --seconds; allowed for: pool, server"),
        ("physics", {"rounds": 1}, "bench physics has no --rounds; allowed for: pool, server, storage"),
    ],
)
def test_sizes_that_measure_nothing_are_refused(name: str, sizes: dict[str, float], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        registry.measure(name, lambda _: None, **sizes)

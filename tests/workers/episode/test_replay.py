"""Laws of recorded episodes that run again: the same as recorded, also in branches, wherever these leave them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import schema
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.episode import replay
from t6gps.workers.episode.replay import Recorded
from t6gps.workers.episode.task import running_cost
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.state import RobotState
from t6gps.workers.settings import RandomisationSettings, RolloutSettings, TaskSettings, TerrainSettings
from t6gps.workers.worker import RolloutWorker

STEPS, PIECE = 60, 10
PLAN = EpisodePlan(
    episode_id=0,
    iteration=0,
    index=0,
    seed=11,
    steps=STEPS,
    terrain_seed=3,
    terrain_difficulty=1.0,
    noise_std_m=0.15,
    policy_version=0,
)
ROUGH = RolloutSettings(terrain=TerrainSettings(difficulty=1.0))
WORLDS = {
    "rough": (ROUGH, PLAN),
    "others": (
        RolloutSettings(randomisation=RandomisationSettings(mass_spread=0.2, largest_delay_steps=4)),
        replace(PLAN, terrain_difficulty=0.0),
    ),
    "noise-free": (
        RolloutSettings(task=TaskSettings(directions=4)),  # the direction of the waypoint stays the same
        replace(PLAN, terrain_difficulty=0.0, noise_std_m=0.0),
    ),
}
"""Settings and plan by name; `others` is a robot that differs from the configured one and heeds commands late."""


def moving_policy() -> PolicySnapshot:
    rng = np.random.default_rng(0)
    layers = tuple(
        ((0.3 * rng.standard_normal((b, a))).astype(np.float32), np.zeros(b, dtype=np.float32))
        for a, b in pairwise([schema.OBSERVATION_N, 16, 24])
    )
    return PolicySnapshot(0, layers, 1.088, 0.2)


@cache
def sampled(world: str) -> tuple[Episode, Recorded]:
    settings, plan = WORLDS[world]
    episode = RolloutWorker(settings).run(plan, moving_policy())
    return episode, replay.recorded(episode, plan, settings)


def branches(recorded: Recorded, rows: list[int], branch: Callable[..., RobotState]) -> dict[int, RobotState]:
    """What a branch gives in the rows that are visited."""
    found: dict[int, RobotState] = {}
    with PyBulletEngine(recorded.settings.robot) as engine:

        def visit(row: int, back: Callable[[], None]) -> None:
            branch(engine, recorded, row)  # another one before it leaves nothing behind
            back()
            found[row] = branch(engine, recorded, row)

        replay.revisited(engine, recorded, moving_policy(), rows, visit)
    return found


@pytest.mark.parametrize("world", WORLDS)
def test_a_recorded_piece_costs_the_same_again(world: str) -> None:
    episode, recorded = sampled(world)
    assert world != "others" or recorded.delay_steps > 0
    rows = list(range(0, STEPS - PIECE, 12))
    again = branches(
        recorded,
        rows,
        lambda engine, episode, row: replay.commanded(engine, episode, row, episode.action[row : row + PIECE]),
    )
    assert sorted(again) == rows
    cost = episode.frames.column("cost").to_numpy()
    for row, states in again.items():
        way = recorded.waypoint[row + 1 : row + 1 + PIECE] - states.com[:, :2]
        direction = way / np.linalg.norm(way, axis=1, keepdims=True)
        replayed = running_cost(states.com_velocity, direction, recorded.settings.task)
        assert np.abs(replayed - cost[row + 1 : row + 1 + PIECE]).max() < 1e-3


def test_a_noise_free_episode_goes_on_as_recorded_under_its_policy() -> None:
    _, recorded = sampled("noise-free")
    again = branches(
        recorded,
        [0, 17, 35],
        lambda engine, episode, row: replay.followed(engine, episode, row, episode.action[row], moving_policy(), PIECE),
    )
    for row, states in again.items():
        recorded_m_per_s = recorded.state.com_velocity[row + 1 : row + 1 + PIECE]
        assert np.abs(states.com_velocity - recorded_m_per_s).max() < 1e-3


def test_a_row_in_which_the_robot_is_not_as_recorded_is_passed_over() -> None:
    _, recorded = sampled("rough")
    bars = recorded.state.bars.copy()
    bars[20, 0, 0] += 0.01
    altered = replace(recorded, state=RobotState(bars, recorded.state.rest_lengths))
    again = branches(
        altered, [10, 20], lambda engine, episode, row: replay.commanded(engine, episode, row, episode.action[row:][:1])
    )
    assert list(again) == [10]


@pytest.mark.parametrize("world", WORLDS)
def test_canonical_columns_of_a_state_are_those_recorded(world: str) -> None:
    episode, recorded = sampled(world)
    for row in range(0, STEPS, 9):
        state = RobotState(recorded.state.bars[row], recorded.state.rest_lengths[row])
        found = replay.canonical(state, int(recorded.face[row]), int(recorded.element[row]))
        for name, values in found.items():
            assert values == pytest.approx(_entry(episode.frames, name, row), abs=1e-5)


def _entry(frames: pa.Table, name: str, row: int) -> list[float]:
    entry: list[float] = frames.column(name)[row].as_py()
    return entry

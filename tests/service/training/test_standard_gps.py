"""Laws of standard GPS: samples lie in world axes and labels, one class per direction, one model per time step."""

from __future__ import annotations

import itertools

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.alternatives import standard_gps
from t6gps.learner.episodes import Episodes
from t6gps.learner.phases import PHASES
from t6gps.learner.rows import NONE, Rows
from t6gps.service import seeding
from t6gps.service.config import Config, load
from t6gps.service.execution.serial import SerialExecutor, new_learner
from t6gps.storage import schema
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import Episode
from t6gps.workers.robot.symmetry import CABLE_MAP, world_map

DIRECTIONS, STEPS = 3, 30
SETTINGS = [
    f"task.directions={DIRECTIONS}",
    f"run.steps={STEPS}",
    "run.episodes=12",
    "exploration.noise_std_m=0.6",
    "learner.localization=time",
    "learner.value_from=0",
    "learner.horizon_steps=30",
    "learner.longest_segment_steps=30",
    "learner.smallest_class_segments=1",
    "learner.epochs=1",
    "learner.hidden_layers=[8]",
]


@pytest.fixture(scope="module")
def config() -> Config:
    return load("flat-quick", SETTINGS)


@pytest.fixture(scope="module")
def executor(config: Config) -> SerialExecutor:
    return SerialExecutor(config)


@pytest.fixture(scope="module")
def episodes(config: Config, executor: SerialExecutor) -> dict[int, pa.Table]:
    sampled: list[Episode] = []
    executor.sample(seeding.training_plans(config, 0), executor.learner.policy(), sampled.append)
    return {episode.episode_id: episode.frames for episode in sampled}


@pytest.fixture(scope="module")
def rows(episodes: dict[int, pa.Table]) -> Rows:
    reading = standard_gps.InWorld(CABLE_MAP)
    taken = Episodes([reading], STEPS)
    for number, frames in reversed(episodes.items()):
        taken.add(number, frames, {"noise_std_m": 0.15})
    return reading.rows(taken.joined()[0])


def test_rows_are_in_world_axes(episodes: dict[int, pa.Table], rows: Rows) -> None:
    table = pa.concat_tables([episodes[key] for key in sorted(episodes)])
    element, yaw = schema.array(table, "element"), schema.array(table, "frame_yaw_rad")
    maps = world_map(element, yaw.astype(np.float64))
    np.testing.assert_allclose(
        np.einsum("tij,tj->ti", maps, rows.state[:, :3]), schema.array(table, "com_velocity"), atol=1e-5
    )
    np.testing.assert_allclose(
        np.einsum("tij,tj->ti", maps[:, :2, :2], rows.target), schema.array(table, "target_direction"), atol=1e-5
    )
    axes = rows.state[:, 21:].reshape(-1, 6, 3)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=2), 1.0, atol=1e-5)
    assert len(set(element.tolist())) > 1


def test_world_labels_and_canonical_labels_are_inverse(episodes: dict[int, pa.Table], rows: Rows) -> None:
    table = pa.concat_tables([episodes[key] for key in sorted(episodes)])
    assert rows.labels is not None
    back = standard_gps.to_canonical(rows.action[rows.acts], rows.labels[rows.acts])
    np.testing.assert_array_equal(back, schema.array(table, "action"))


def test_every_direction_is_a_class_and_every_time_step_a_model(
    config: Config, episodes: dict[int, pa.Table], rows: Rows
) -> None:
    assert rows.entry.reshape(12, -1).tolist() == [[row] * (STEPS + 1) for row in rows.entry[:: STEPS + 1]]
    assert (rows.exit == NONE).all()
    learner = new_learner(config)
    for frames in episodes.values():
        learner.add(frames, 0.15)
    for phase in PHASES:
        list(getattr(learner, phase.name)())
    report, classes, models = learner.report()
    assert report["segments"] == 12
    assert [(row["entry_edge"], row["segments"], row["time_steps"]) for row in classes] == [
        (direction, 12 // DIRECTIONS, STEPS) for direction in range(DIRECTIONS)
    ]
    assert set(zip(models["bin"].to_pylist(), models["step"].to_pylist(), strict=True)) == set(
        itertools.product(range(DIRECTIONS), range(STEPS))
    )


def test_standard_gps_without_a_common_start_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"learner.localization = time needs a common start"):
        load("flat-quick", ["learner.localization=time", "learner.value_from=0"])

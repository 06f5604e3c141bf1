"""The benchmark of growth runs whole iterations of the sizes that it says."""

from __future__ import annotations

import pytest

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench.scaling.growth import growth
from t6gps.service.execution.serial import SerialExecutor
from t6gps.storage.records import Episode


@pytest.mark.slow
def test_iterations_of_more_data_have_as_many_steps_more() -> None:
    config = configuration.load("rough", ["run.episodes=3", "run.steps=60"])
    executor, episodes = SerialExecutor(config), list[Episode]()
    executor.sample(seeding.training_plans(config, 0), executor.learner.policy(), episodes.append)
    executor.close()
    said: list[str] = []
    figures = growth(episodes, said.append, factors=(2,))
    assert figures["iteration_2x_steps"] == 2 * sum(episode.summary["steps"][0].as_py() for episode in episodes)
    assert figures["iteration_2x_supervisor_peak_mb"] > 50 and figures["iteration_2x_learner_peak_mb"] > 50
    assert figures["iteration_2x_segmenting_s"] > 0 and figures["iteration_2x_commit_s"] > 0
    assert [line.split(":")[0] for line in said] == ["2 times the data"]

"""Laws of the stream to the learner: it is bounded while the learner stands still, and nothing of it is lost."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import closing
from typing import Any

import pytest
import ray
from house import joining

from t6gps.learner.phases import PHASES
from t6gps.service import provenance, seeding
from t6gps.service.config import load
from t6gps.service.execution.ray_executor import RayExecutor
from t6gps.service.execution.ray_learner import EPISODES_PER_CALL_N, EPISODES_UNDER_WAY_N, as_at_home
from t6gps.service.execution.serial import SerialExecutor
from t6gps.service.pool.deadlines import Timings
from t6gps.storage.errors import LearnerDiedError, RunError
from t6gps.storage.records import Episode

SETTINGS = ["run.episodes=60", "run.steps=10", "learner.smallest_class_segments=4", "learner.epochs=1"]
PAUSE_S = 60.0 if "T6GPS_SOAK_MINUTES" in os.environ else 2.0
MOST_N = EPISODES_UNDER_WAY_N + EPISODES_PER_CALL_N
"""Kept while the learner stands still: those of one more call, with which sampling waits."""
WORKERS_N = 2


@pytest.mark.slow
def test_t13_while_the_learner_stands_still_sampling_waits_and_then_ends_with_the_same_policy(
    ray_head: dict[str, str],
) -> None:
    config = load("flat-quick", [*SETTINGS, f"run.workers={WORKERS_N}", "run.cpus_per_worker=0.5"])
    plans = seeding.training_plans(config, 0)
    kept_s: list[float] = []
    resumed_s: list[float] = []
    with joining(ray_head), closing(RayExecutor(config)) as executor:
        learner: Any = executor.learner.actor
        process = ray.get(learner.__ray_call__.remote(lambda _: os.getpid()))

        def resume() -> None:
            resumed_s.append(time.monotonic())
            os.kill(process, signal.SIGCONT)

        def keep(episode: Episode) -> None:
            if not kept_s:
                os.kill(process, signal.SIGSTOP)
            kept_s.append(time.monotonic())
            if len(kept_s) == MOST_N:
                threading.Timer(PAUSE_S, resume).start()  # until then any more would be kept
            executor.feed(episode)

        executor.sample(plans, executor.learner.policy(), keep)
        for phase in PHASES:
            list(executor.learn(phase))
        streamed = executor.learner.policy()
    assert len(kept_s) == len(plans)
    assert sum(at_s < resumed_s[0] for at_s in kept_s) == MOST_N

    serial = SerialExecutor(config)
    with closing(serial):
        serial.sample(plans, serial.learner.policy(), serial.feed)
        for phase in PHASES:
            list(serial.learn(phase))
    for (weight, bias), (expected_weight, expected_bias) in zip(
        streamed.layers, serial.learner.policy().layers, strict=True
    ):
        assert (weight == expected_weight).all() and (bias == expected_bias).all()


@pytest.mark.slow
def test_t10_a_learner_that_hangs_is_ended_and_another_one_takes_its_place(ray_head: dict[str, str]) -> None:
    config = load("flat-quick", [*SETTINGS, f"run.workers={WORKERS_N}", "run.cpus_per_worker=0.5"])
    timings = Timings(learner_silent_s=12.0)  # a busy machine starts it with silence of some seconds
    with joining(ray_head), closing(RayExecutor(config, timings=timings)) as executor:
        first: Any = executor.learner.actor
        untrained = executor.learner.policy()
        os.kill(ray.get(first.__ray_call__.remote(lambda _: os.getpid())), signal.SIGSTOP)
        with pytest.raises(LearnerDiedError, match=r"no sign of life for .* stopped"):
            executor.learner.policy()
        executor.replace_learner()
        again = executor.learner.policy()
    for (weight, _), (before, _) in zip(again.layers, untrained.layers, strict=True):
        assert (weight == before).all()


def test_a_fit_on_a_node_with_another_installation_is_refused() -> None:
    build = provenance.build()
    assert as_at_home(len, build)("abc") == 3
    with pytest.raises(RunError, match=r"node \S+ has another installation than the run: t6gps \S+ \(the run: 0.0\)"):
        as_at_home(len, build | {"t6gps": "0.0"})("abc")

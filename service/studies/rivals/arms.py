"""A rival's run: it trains, is evaluated at each mark on the way, and leaves its curve.

A run that was interrupted begins anew. Its seed decides everything, so what it had kept comes again.
"""

from __future__ import annotations

import time
from collections.abc import Generator, Sequence
from contextlib import closing
from functools import partial

import numpy as np

from t6gps.service.config import Config
from t6gps.service.studies import controllers
from t6gps.service.studies.declared import BY_HAND, Rival
from t6gps.service.studies.rivals import curve, gaits
from t6gps.service.studies.rivals.curve import Point
from t6gps.service.studies.rivals.port import Train, Trained
from t6gps.service.studies.rivals.senses import Actions
from t6gps.service.studies.rivals.settings import MARKS, PATTERN_SPREAD, REFLEX_SPREAD
from t6gps.service.studies.watcher import Progress, Watcher
from t6gps.service.training import evaluation, origin
from t6gps.service.training.evaluation_records import Occasion, Purpose
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.workers.episode.gaits import flop
from t6gps.workers.robot.neutral import nominal_rest_length


def complete(rival: Rival, config: Config, run: Run, watcher: Watcher) -> None:
    """Train a rival with the steps that `config` allows, and keep its evaluation at each mark."""
    config = origin.at_work(config, run)
    points, wall_s, cpu_s, marks = list[Point](), 0.0, 0.0, marks_of(rival, config)
    with (
        catalog.locked(run),
        watcher.task(f"training {rival.value}") as progress,
        closing(learner(rival)(config, marks, progress)) as stages,
    ):
        for mark in marks:
            wall_start, cpu_start = time.perf_counter(), time.process_time()
            trained = next(stages)
            wall_s += time.perf_counter() - wall_start
            cpu_s += time.process_time() - cpu_start
            passing = Occasion(Purpose.CONDITION, f"after-{mark}-steps")
            occasion = Occasion(Purpose.TRAINING) if mark == marks[-1] else passing
            result = controllers.evaluate(run, config, trained.control, occasion)
            points.append(Point(trained.steps, round(wall_s, 1), round(cpu_s, 1), result))
            curve.keep(run, points)
    evaluation.keep(run, points[-1].evaluation)


def marks_of(rival: Rival, config: Config) -> list[int]:
    """Control steps after which a rival is evaluated: the budget of `config`, and the smaller marks if it learns."""
    size = config.run
    budget = size.iterations * size.episodes * size.steps
    return [*(mark for mark in MARKS if mark < budget and rival not in BY_HAND), budget]


def learner(rival: Rival) -> Train:
    """How a rival learns. Its libraries are imported here; `conduct` has made sure that they are installed."""
    match rival:
        case Rival.GAIT:
            return _by_hand
        case Rival.CPG | Rival.CMA_ES:
            from t6gps.service.studies.rivals import evolution

            if rival is Rival.CPG:
                return partial(evolution.train, gaits.pattern, gaits.by_hand(), PATTERN_SPREAD)
            return partial(evolution.train, gaits.reflex, np.zeros(gaits.REFLEX_N), REFLEX_SPREAD)
        case _:
            name, actions = rival.value.split("-")
            if name == "ppo":
                from t6gps.service.studies.rivals import on_policy

                return partial(on_policy.train, Actions(actions))
            from t6gps.service.studies.rivals import off_policy

            return partial(off_policy.train, off_policy.Algorithm(name), Actions(actions))


def _by_hand(config: Config, marks: Sequence[int], progress: Progress) -> Generator[Trained]:
    """The gait that learns nothing, once."""
    progress(marks[-1], marks[-1])
    yield Trained(0, flop(nominal_rest_length(config.robot)))

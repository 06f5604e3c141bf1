"""Evaluations of controllers that are no policy of T6-GPS, on the episodes that any policy of the run would get."""

from __future__ import annotations

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.training import evaluation, evaluation_records
from t6gps.service.training.evaluation import Evaluation, Judged
from t6gps.service.training.evaluation_records import Occasion
from t6gps.storage.catalog import Run
from t6gps.workers.episode.rollout import Controller, controlled
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length


def evaluate(run: Run, config: Config, control: Controller, occasion: Occasion) -> Evaluation:
    """The evaluation of a controller; it and its episodes are kept in the tables of the run."""
    size, nominal_m, found = config.run, nominal_rest_length(config.robot), list[Judged]()
    plans = seeding.evaluation_plans(config, size.evaluation_episodes, size.seed, None, 0)
    with PyBulletEngine(config.robot) as engine, evaluation_records.collecting(run) as episodes:
        for plan in plans:
            episode = controlled(engine, config.rollout, plan, control, 0, nominal_m)
            found.append(evaluation.judged(episode, config))
            episodes.append(episode)
        result = evaluation.summarise(found, size.seed)
        evaluation_records.commit(run, config, result, episodes, occasion, 0)
    return result

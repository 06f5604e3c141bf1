"""How well a policy does without noise, on seeds that it was not trained on."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor, Purpose
from t6gps.service.training.loop import Observer, mean_and_error
from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.records import Episode

EVALUATED = {
    "forward_speed_m_per_s": "forward_speed_m_per_s",
    "stuck_share": "stuck_share",
    "stuck_share_by_distance": "stuck_share_by_distance",
    "waypoints_per_episode": "waypoints_reached",
    "cost": "cost",
}
"""Reported quantities and the columns of `episodes` they summarise."""

Evaluation = dict[str, Any]
"""`episodes`, `seed`, and of each of EVALUATED its mean and standard error over the episodes that have it (or None)."""


def evaluate(
    config: Config, executor: Executor, episodes: int, seed: int, terrain_seed: int | None, observer: Observer
) -> Evaluation:
    """Run the learner's policy in `episodes` noise-free episodes."""
    snapshot = executor.learner.policy()
    plans = seeding.evaluation_plans(config, episodes, seed, terrain_seed, snapshot.version)
    summaries: dict[int, pa.Table] = {}

    def keep(episode: Episode) -> None:
        summaries[episode.summary["index"][0].as_py()] = episode.summary.take(
            [0]
        )  # a copy: the episode's memory is not held
        observer.progress(snapshot.version, "evaluate", len(summaries), episodes)

    executor.sample(plans, snapshot, keep, Purpose.EVALUATION)
    return summarise([summaries[index] for index in sorted(summaries)], seed)


def summarise(summaries: Sequence[pa.Table], seed: int) -> Evaluation:
    """The evaluation that episodes (rows of `episodes`) make up."""
    table = pa.concat_tables(summaries)
    result: Evaluation = {"episodes": len(summaries), "seed": seed}
    for key, column in EVALUATED.items():
        values = table[column].drop_null().to_numpy().astype(float)
        mean, error = mean_and_error(values) if len(values) else (None, None)
        result[key] = {"mean": mean, "standard_error": error}
    return result


def keep(run: Run, evaluation: Evaluation, condition: str | None = None) -> None:
    """Keep the evaluation that ended the training, or one under another condition, beside the run's tables."""
    path = _path(run, condition)
    path.parent.mkdir(exist_ok=True)
    durable.hidden(path).write_text(json.dumps(evaluation, indent=2) + "\n")
    durable.publish(path)


def kept(run: Run, condition: str | None = None) -> Evaluation | None:
    """The evaluation that ended the training, or one under another condition; None before it is kept."""
    path = _path(run, condition)
    return json.loads(path.read_text()) if path.exists() else None


def _path(run: Run, condition: str | None) -> Path:
    return run.path / "evaluation.json" if condition is None else run.path / "conditions" / f"{condition}.json"

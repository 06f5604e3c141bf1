"""How well a policy does without noise, on seeds that it was not trained on."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import pyarrow as pa

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor, Purpose
from t6gps.service.training.loop import Observer, mean_and_error
from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.workers.locomotion.measures import Measures, measures

FILE = "evaluation.json"
RECORDED = {
    "forward_speed_m_per_s": "forward_speed_m_per_s",
    "stuck_share_by_distance": "stuck_share_by_distance",
    "stuck_share_by_speed": "stuck_share",
    "waypoints_per_episode": "waypoints_reached",
    "cost": "cost",
}
"""Quantities that the row of an episode holds, and their columns in `episodes`."""

EVALUATED = (*RECORDED, *(field.name for field in fields(Measures)))
"""Reported quantities: those, and what is measured along the frames of an episode."""

Judged = Mapping[str, float | None]
"""The quantities of one episode, by name."""


@dataclass(frozen=True)
class Estimate:
    """Mean and standard error over the episodes that have a quantity.

    Both are None where no episode has it; a single episode has no standard error.
    """

    mean: float | None = None
    standard_error: float | None = None


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What a policy does without noise, over a number of episodes whose starts and waypoints hang on `seed`.

    forward_speed_m_per_s       speed towards the waypoint (m/s)
    stuck_share_by_distance     share of time in which the robot is less than 5 cm from where it was 1 s before
    stuck_share_by_speed        share of time in which its centre of mass is slower than 0.05 m/s in space, which one
                                that rocks on the spot is not
    waypoints_per_episode       waypoints reached before their time was up; None where the task has directions
    cost                        mean running cost (m2/s2)

    The others are means over episodes of `workers.locomotion.measures.Measures`.
    """

    episodes: int
    seed: int
    forward_speed_m_per_s: Estimate = Estimate()
    stuck_share_by_distance: Estimate = Estimate()
    stuck_share_by_speed: Estimate = Estimate()
    waypoints_per_episode: Estimate = Estimate()
    cost: Estimate = Estimate()
    speed_over_winch_speed: Estimate = Estimate()
    bar_lengths_per_s: Estimate = Estimate()
    cost_of_transport: Estimate = Estimate()
    slip_per_metre: Estimate = Estimate()
    sunk_cable_share: Estimate = Estimate()

    def estimates(self) -> dict[str, Estimate]:
        """The quantities by name, in the order of EVALUATED."""
        return {name: getattr(self, name) for name in EVALUATED}

    def to_json(self, indent: int | None = None) -> str:
        """The evaluation as the run keeps it."""
        return json.dumps(asdict(self), indent=indent)

    @classmethod
    def from_json(cls, text: str) -> Evaluation:
        """The evaluation that `to_json` wrote; an older run may lack a quantity, or name it `stuck_share`."""
        stored = durable.parsed(text)
        if "stuck_share" in stored:
            stored["stuck_share_by_speed"] = stored.pop("stuck_share")
        estimates = {name: Estimate(**stored[name]) for name in EVALUATED if name in stored}
        return cls(episodes=stored["episodes"], seed=stored["seed"], **estimates)


def evaluate(
    config: Config,
    executor: Executor,
    episodes: int,
    seed: int,
    terrain_seed: int | None,
    observer: Observer,
    policy: PolicySnapshot | None = None,
    append: Callable[[Episode], object] | None = None,
) -> Evaluation:
    """Run a policy, by default the learner's newest, in `episodes` noise-free episodes; each is handed to `append`."""
    snapshot = executor.learner.policy() if policy is None else policy
    plans = seeding.evaluation_plans(config, episodes, seed, terrain_seed, snapshot.version)
    found: dict[int, Judged] = {}

    def keep(episode: Episode) -> None:
        found[episode.summary["index"][0].as_py()] = judged(episode, config)
        if append is not None:
            append(episode)
        observer.progress(snapshot.version, "evaluate", len(found), episodes)

    executor.sample(plans, snapshot, keep, Purpose.EVALUATION)
    if not found:
        where = executor.run.bundles if executor.run else "the log"
        raise RunError(f"every episode of the evaluation is quarantined; see {where}, mend the cause, then try again")
    return summarise([found[index] for index in sorted(found)], seed)


def judged(episode: Episode, config: Config) -> Judged:
    """The quantities of an episode that was run in the world of a configuration."""
    recorded = {name: episode.summary[column][0].as_py() for name, column in RECORDED.items()}
    return {**recorded, **asdict(measures(episode, config.rollout))}


def summarise(episodes: Sequence[Judged], seed: int) -> Evaluation:
    """The evaluation that episodes make up."""
    values = {name: pa.chunked_array([[row[name] for row in episodes]], pa.float64()) for name in EVALUATED}
    estimates = {name: Estimate(*mean_and_error(column)) for name, column in values.items()}
    return Evaluation(episodes=len(episodes), seed=seed, **estimates)


def keep(run: Run, evaluation: Evaluation, condition: str | None = None) -> None:
    """Keep the evaluation that ended the training, or one under another condition, beside the run's tables."""
    path = _path(run, condition)
    path.parent.mkdir(exist_ok=True)
    durable.hidden(path).write_text(evaluation.to_json(indent=2) + "\n")
    durable.publish(path)


def kept(run: Run, condition: str | None = None) -> Evaluation | None:
    """The evaluation that ended the training, or one under another condition; None before it is kept.

    RunError where its file is damaged.
    """
    path = _path(run, condition)
    if not path.exists():
        return None
    try:
        return Evaluation.from_json(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        raise RunError(
            f"run {run.name} is not whole: {path} cannot be read: {error!r}; restore it from a copy, or remove it and "
            "resume the run"
        ) from None


def _path(run: Run, condition: str | None) -> Path:
    return run.path / FILE if condition is None else run.path / "conditions" / f"{condition}.json"

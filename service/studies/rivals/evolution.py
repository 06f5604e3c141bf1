"""CMA-ES, from cmaes, on the parameters of a gait: each is judged by one short episode of training without noise.

All of a generation run the same episode, and each generation the next one, so that luck with the ground favours nobody.
What a mark gives is the mean of the distribution, not the luckiest offspring.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from itertools import count

from cmaes import CMA

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.seeding import Branch
from t6gps.service.studies.rivals.port import Trained
from t6gps.service.studies.rivals.senses import Array
from t6gps.service.studies.rivals.settings import EVOLUTION_STEPS
from t6gps.service.studies.watcher import Progress
from t6gps.storage.records import EpisodePlan
from t6gps.workers.episode.rollout import Controller, controlled
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length

Gait = Callable[[float, Array], Controller]
"""Takes the nominal rest length (m) and parameters."""


def train(
    gait: Gait, start: Array, spread: float, config: Config, marks: Sequence[int], progress: Progress
) -> Generator[Trained]:
    """Learn as `port.Train` says, in whole generations; where none fits, what comes out is the start."""
    nominal_m = nominal_rest_length(config.robot)
    optimizer = CMA(start, spread, seed=seeding.number(config.run.seed, Branch.RIVALS, 0))
    plans = (
        replace(plan, steps=EVOLUTION_STEPS, noise_std_m=0.0)
        for number in count()
        for plan in seeding.training_plans(config, number)
    )
    generation_steps, steps = optimizer.population_size * EVOLUTION_STEPS, 0
    with PyBulletEngine(config.robot) as engine:
        for mark in marks:
            while steps + generation_steps <= mark:
                plan, judged = next(plans), []
                for _ in range(optimizer.population_size):
                    parameters = optimizer.ask()
                    judged.append((parameters, _loss(engine, config, plan, gait(nominal_m, parameters))))
                optimizer.tell(judged)
                steps += generation_steps
                progress(steps, marks[-1])
            yield Trained(steps, gait(nominal_m, optimizer.mean))


def _loss(engine: PyBulletEngine, config: Config, plan: EpisodePlan, control: Controller) -> float:
    """Mean cost (m2/s2) of an episode; once the state is out of range, that of rest."""
    summary = controlled(engine, config.rollout, plan, control, 0, nominal_rest_length(config.robot)).summary
    cost, steps = (summary[name][0].as_py() for name in ("cost", "steps"))
    return float(cost * steps + config.task.target_speed_m_per_s**2 * (plan.steps - steps)) / plan.steps

"""Controllers to compare with: a gait by hand, an evolved open-loop gait, and PPO from stable-baselines3.

Each samples as many control steps as the run's configuration says (PPO rounds them up to whole batches of 2048) and is
evaluated on the same episodes as T6-GPS. A baseline that is interrupted starts anew, since its training is short.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.seeding import Branch
from t6gps.service.studies import controllers
from t6gps.service.studies.declared import Baseline
from t6gps.service.studies.watcher import Progress, Watcher
from t6gps.service.training import evaluation, origin, session
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.evaluation_records import Occasion, Purpose
from t6gps.service.training.loop import Observer
from t6gps.storage import catalog, checkpoint, durable
from t6gps.storage.catalog import Run
from t6gps.storage.checkpoint import JSON
from t6gps.storage.errors import RunError
from t6gps.storage.records import EpisodePlan
from t6gps.workers.episode import gaits
from t6gps.workers.episode.rollout import Controller, controlled
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length

if TYPE_CHECKING:
    from stable_baselines3 import PPO

Array = NDArray[np.float64]

OFFSPRING_N, PARENTS_N = 12, 4
FIRST_SPREAD, SPREAD_DECAY = 0.5, 0.97
"""Standard deviation of the first generation, in units of `gaits.WAVE_SCALE_M`, and its factor per generation."""
EVOLUTION_STEPS = 100
PPO_STEPS_N, PPO_BATCH_N = 2048, 256
PPO_DISCOUNT = 0.95
"""A horizon of about two seconds, as long as sub-trajectories look ahead; the rest are stable-baselines3's defaults."""


def complete(baseline: Baseline, config: Config, run: Run, watcher: Watcher) -> None:
    """Train a baseline with the steps that `config` allows, keep what it learned, and keep its evaluation."""
    config = origin.at_work(config, run)
    steps = config.run.iterations * config.run.episodes * config.run.steps
    with catalog.locked(run), watcher.task(f"training {baseline.value}") as progress:
        if baseline is Baseline.PERIODIC:
            _keep_gait(run, evolve(config, steps, progress))
        elif baseline is Baseline.PPO:
            model = train_ppo(config, steps, progress)
            checkpoint.save(run.checkpoints, config.run.iterations, *learner_state(model, config))
    with watcher.run(config.run.iterations) as observer:
        evaluation.keep(run, evaluate(baseline, run, (), True, observer))


def evaluate(
    baseline: Baseline,
    run: Run,
    overrides: Sequence[str],
    serial: bool,
    observer: Observer,
    condition: str | None = None,
) -> Evaluation:
    """The evaluation of a finished baseline on the episodes that any policy of this run would get, and it is kept."""
    if baseline is Baseline.PPO:
        return session.evaluate_newest(run, overrides, serial, observer, condition)
    config = origin.configured(run, overrides)
    nominal_m = nominal_rest_length(config.robot)
    control = gaits.flop(nominal_m) if baseline is Baseline.FLOP else gaits.waves(nominal_m, _kept_gait(run))
    purpose = Purpose.TRAINING if condition is None else Purpose.CONDITION
    return controllers.evaluate(run, config, control, Occasion(purpose, condition))


def _keep_gait(run: Run, parameters: Array) -> None:
    path = run.path / "gait.json"
    durable.hidden(path).write_text(json.dumps(parameters.tolist()))
    durable.publish(path)


def _kept_gait(run: Run) -> Array:
    return np.array(durable.parsed((run.path / "gait.json").read_text()))


def evolve(config: Config, steps: int, progress: Progress) -> Array:
    """Parameters [49] of the open-loop gait that travels fastest along +x, from rest, in at most `steps` control steps.

    A (4, 12) evolution strategy with a spread that shrinks. RunError if the steps make up no generation.
    """
    generations = steps // (OFFSPRING_N * EVOLUTION_STEPS)
    if not generations:
        raise RunError(f"{steps} steps make up no generation of {OFFSPRING_N} x {EVOLUTION_STEPS}; allow more steps")
    rng = seeding.generator(config.run.seed, Branch.BASELINES)
    settings = config.rollout
    terrain = settings.terrain.model_copy(update={"difficulty": 0.0, "tilt_deg": 0.0, "file": None})
    settings = settings.model_copy(
        update={"task": settings.task.model_copy(update={"directions": 1}), "terrain": terrain}
    )
    nominal_m = nominal_rest_length(config.robot)
    plan = EpisodePlan(0, 0, 0, 0, EVOLUTION_STEPS, 0, 0.0, 0.0, 0)
    mean, spread = np.zeros(gaits.WAVE_PARAMETERS_N), FIRST_SPREAD
    best, fastest = mean, -np.inf
    with PyBulletEngine(config.robot) as simulation:

        def speed(parameters: Array) -> float:
            control: Controller = gaits.waves(nominal_m, parameters)
            summary = controlled(simulation, settings, plan, control, 0, nominal_m).summary
            return float(summary["forward_speed_m_per_s"][0].as_py())

        for generation in range(generations):
            offspring = mean + spread * rng.standard_normal((OFFSPRING_N, len(mean)))
            speeds = np.array([speed(parameters) for parameters in offspring])
            order = np.argsort(-speeds)
            mean, spread = offspring[order[:PARENTS_N]].mean(axis=0), spread * SPREAD_DECAY
            if speeds[order[0]] > fastest:
                best, fastest = offspring[order[0]], speeds[order[0]]
            progress(generation + 1, generations)
    return best


def train_ppo(config: Config, steps: int, progress: Progress) -> PPO:
    """The PPO model that `steps` steps of the Gymnasium environment make."""
    import torch

    torch.set_num_threads(1)
    model = new_ppo(config)

    def follow(_: object, __: object) -> bool:
        progress(min(model.num_timesteps, steps), steps)
        return True

    model.learn(steps, callback=follow)
    if model.env is not None:
        model.env.close()
    return model


def new_ppo(config: Config) -> PPO:
    """An untrained PPO model whose actor is a tanh network with the layers of the policy of T6-GPS."""
    from gymnasium.wrappers import TimeLimit
    from stable_baselines3 import PPO
    from torch.nn import Tanh

    from t6gps.workers.environment import SuperBallEnvironment

    environment = TimeLimit(SuperBallEnvironment(config.robot, config.task, config.terrain), config.run.steps)
    network = {"net_arch": list(config.learner.hidden_layers), "activation_fn": Tanh, "log_std_init": -1.0}
    return PPO(
        "MlpPolicy",
        environment,
        n_steps=PPO_STEPS_N,
        batch_size=PPO_BATCH_N,
        gamma=PPO_DISCOUNT,
        policy_kwargs=network,
        seed=config.run.seed,
        device="cpu",
    )


def learner_state(model: PPO, config: Config) -> tuple[dict[str, JSON], dict[str, NDArray[np.float32]]]:
    """State of a learner (`Learner.restore`) whose policy commands the mean action of a PPO model."""
    weights, hidden_n = model.policy.state_dict(), len(config.learner.hidden_layers)
    names = [*(f"mlp_extractor.policy_net.{2 * number}" for number in range(hidden_n)), "action_net"]
    arrays = {
        f"layer_{number}_{part}": weights[f"{name}.{part}"].numpy().astype(np.float32)
        for number, name in enumerate(names)
        for part in ("weight", "bias")
    }
    middle_m = (config.robot.longest_command_m + config.robot.shortest_command_m) / 2
    half_m = (config.robot.longest_command_m - config.robot.shortest_command_m) / 2
    offset_m = nominal_rest_length(config.robot)
    # Actions -1 .. 1 span the commands about their middle; the snapshot puts zero at the nominal rest length.
    arrays[f"layer_{len(names) - 1}_bias"] += np.float32((middle_m - offset_m) / half_m)
    manifest: dict[str, JSON] = {
        "version": config.run.iterations,
        "offset_m": offset_m,
        "scale_m": half_m,
        "layers": len(names),
        "replays": 0,
    }
    return manifest, arrays

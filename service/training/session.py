"""From a configuration to a finished run, the same for a single training and for a study."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

from t6gps.service import caller, checks, logs
from t6gps.service import config as configuration
from t6gps.service.checks import Wanted
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.logs import Role
from t6gps.service.pool.state import RunState
from t6gps.service.steering.watch import heeding
from t6gps.service.training import evaluation, evaluation_records, loop, origin, policies, publishing
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.evaluation_records import Occasion, Purpose
from t6gps.service.training.loop import Observer
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import LearnerDiedError, RunError, T6GpsError
from t6gps.storage.objects.place import ObjectPath
from t6gps.storage.records import PolicySnapshot

if TYPE_CHECKING:
    from t6gps.workers.physics import engine as physics
    from t6gps.workers.settings import RobotSettings


Warn = Callable[[str], object]
"""Takes a sentence for whoever should know."""

EVALUATION_SECTIONS = ("robot.", "task.", "terrain.", "randomisation.", "run.steps", "run.workers")


class Engine(StrEnum):
    """Simulators of the robot."""

    BULLET = "bullet"
    MUJOCO = "mujoco"


def start_executor(config: Config, serial: bool, run: Run | None = None, engine: Engine = Engine.BULLET) -> Executor:
    """Workers and learner: on Ray, or in this process when `serial` or with another engine; of the run that trains.

    PhysicsError or TerrainError for a world that no worker can start in.
    """
    from t6gps.workers.episode.stance import check_stance

    check_stance(config.rollout)
    executor: Executor
    if serial or engine is Engine.MUJOCO:
        from t6gps.service.execution.serial import SerialExecutor

        executor = SerialExecutor(config, run, _simulation(engine))
    else:
        with caller.untouched():  # the import of Ray sets a variable
            from t6gps.service.execution.ray_executor import RayExecutor

        executor = RayExecutor(config, run)
    return executor


def _simulation(engine: Engine) -> Callable[[RobotSettings], physics.Engine]:
    if engine is Engine.MUJOCO:
        from t6gps.workers.physics.mujoco_engine import MujocoEngine

        return MujocoEngine
    from t6gps.workers.physics.bullet_engine import PyBulletEngine

    return PyBulletEngine


def check_unchanged(run: Run, config: Config, remedy: str) -> None:
    """RunError with all differences if the run was created with another configuration (workers aside)."""
    changed = origin.differences(run, config)
    if changed:
        raise RunError(f"run {run.name} has another configuration: {'; '.join(changed)}; {remedy}")


def begin(
    config: Config,
    root: Path,
    name: str | None,
    default: str,
    resume: bool,
    warn: Warn,
    copies: ObjectPath | None = None,
) -> Run:
    """The run of that name below `root`: a new one, or with `resume` the one that there is, if there is one.

    Without a name it is `default`, or without `resume` the first of default-2, default-3, ... that is free. RunError
    when the name is taken or refused, when the run to resume has another configuration, or when the root takes no more
    files. `warn` is told what made the run and is another now.

    copies   root in an object store where the run will be published; StoreError where that takes none, RunError where
             it holds another run of the name
    """
    checks.require((checks.root_folder,), Wanted(config.run.workers, catalog.folder(root)))
    chosen = default if name is None else name
    there = resume and catalog.exists(root, chosen)
    if copies is not None:
        publishing.probe(copies, there, warn)
    if there:
        run = catalog.open_run(root, chosen)
        tell_changes(run, warn)
        check_unchanged(run, config, "repeat the run's settings, or start a new run with --run")
    else:
        run = origin.create(config, root, chosen, numbered=name is None and not resume)
    if copies is not None:
        try:
            publishing.check(run, copies)
        except T6GpsError:
            if not there:
                catalog.discard_unused(run)
            raise
    return run


def tell_changes(run: Run, warn: Warn) -> None:
    """Tell what made a run and is another now. RunError for a run of a later version."""
    sentence = origin.changes(run)
    if sentence is not None:
        warn(sentence)


def complete(
    config: Config, run: Run, serial: bool, observer: Observer, copies: ObjectPath | None = None
) -> Evaluation:
    """Train what is missing of a run, evaluate its policy without noise, keep the result, and publish it in `copies`.

    Everything sampled is kept when KeyboardInterrupt comes, also by `t6gps stop`. A run is removed whose first executor
    does not start.
    """
    speaker = logs.other(Role.SUPERVISOR, run.name)
    with catalog.locked(run), _named(run), logs.speaking(speaker):
        config = origin.at_work(config, run)
        try:
            with heeding(run):
                started = start_executor(config, serial, run)
        except BaseException:
            catalog.discard_unused(run)
            raise
        with closing(started) as executor, publishing.beside(run, copies, observer) as watcher:
            with heeding(run):
                result = train_and_evaluate(config, run, executor, watcher)
            executor.close(RunState.DONE)
            evaluation.keep(run, result)
        return result


@contextmanager
def _named(run: Run) -> Iterator[None]:
    """Let errors of the system that name no file, such as a full disk, name the run's folder."""
    try:
        yield
    except OSError as error:
        if error.filename is None:
            error.filename = str(run.path)
        raise


def train_and_evaluate(config: Config, run: Run, executor: Executor, observer: Observer) -> Evaluation:
    """Train what is missing of a run, then evaluate its policy without noise.

    A learner that dies after the last iteration is replaced, as one that dies before.
    """
    deaths_n = 0
    while True:
        loop.train(config, run, executor, observer)
        try:
            policy = executor.learner.policy()
            return _own_evaluation(run, config, executor, policy, Occasion(Purpose.TRAINING), observer)
        except LearnerDiedError:
            deaths_n += 1
            if deaths_n > loop.LEARNER_DEATHS_ALLOWED_N:
                raise
            executor.replace_learner()


@dataclass(frozen=True)
class Asked:
    """Noise-free episodes: how many, on which seeds, of which policy, and whether the run keeps them.

    terrain_seed   of the ground alone
    version        of the policy, the newest by default
    """

    episodes: int
    seed: int
    terrain_seed: int | None = None
    version: int | None = None
    keep: bool = True


def evaluate(
    run: Run,
    config: Config,
    asked: Asked,
    serial: bool,
    engine: Engine,
    observer: Observer,
    policy: PolicySnapshot | None = None,
) -> tuple[Evaluation, int | None]:
    """Evaluate a policy in the world of a configuration; the result, and its number where it is kept.

    RunError for a policy that the run does not keep, and before its first one.
    """
    policy = policy or policies.load(run, asked.version)
    if asked.keep:
        catalog.folder(run.path)
    with closing(start_executor(config, serial, engine=engine)) as executor:
        if asked.keep:
            occasion = Occasion(Purpose.EVAL, terrain_seed=asked.terrain_seed, engine=engine.value)
            return _kept_evaluation(run, config, executor, policy, asked, occasion, observer)
        size = (asked.episodes, asked.seed, asked.terrain_seed)
        return evaluation.evaluate(config, executor, *size, observer, policy), None


def evaluate_newest(
    run: Run, overrides: Sequence[str], serial: bool, observer: Observer, condition: str | None = None
) -> Evaluation:
    """Evaluate a run's newest policy in the world that `overrides` change, on the seeds of the run's own evaluation.

    It is kept as that of a study's condition, or as the one that ends the training.
    """
    config, policy = origin.configured(run, overrides), policies.load(run, None)
    occasion = Occasion(Purpose.TRAINING if condition is None else Purpose.CONDITION, condition)
    with closing(start_executor(config, serial)) as executor:
        return _own_evaluation(run, config, executor, policy, occasion, observer)


def _own_evaluation(
    run: Run, config: Config, executor: Executor, policy: PolicySnapshot, occasion: Occasion, observer: Observer
) -> Evaluation:
    """The evaluation of a policy that the run's configuration asks for."""
    asked = Asked(config.run.evaluation_episodes, config.run.seed)
    return _kept_evaluation(run, config, executor, policy, asked, occasion, observer)[0]


def _kept_evaluation(
    run: Run,
    config: Config,
    executor: Executor,
    policy: PolicySnapshot,
    asked: Asked,
    occasion: Occasion,
    observer: Observer,
) -> tuple[Evaluation, int]:
    with evaluation_records.collecting(run) as episodes:
        size = (asked.episodes, asked.seed, asked.terrain_seed)
        result = evaluation.evaluate(config, executor, *size, observer, policy, episodes.append)
        return result, evaluation_records.commit(run, config, result, episodes, occasion, policy.version)


def evaluation_config(run: Run, overrides: Sequence[str], warn: Warn) -> Config:
    """A run's configuration in the world that `overrides` change. ConfigError for one that would change the policy.

    `warn` is told what made the run and is another now.
    """
    configuration.check_keys(overrides, "eval", EVALUATION_SECTIONS, "the policy is trained already")
    tell_changes(run, warn)
    return origin.configured(run, overrides)

"""From a configuration to a finished run, the same for a single training and for a study."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, cast

from t6gps.learner.port import Manifest
from t6gps.service import caller, checks, logs
from t6gps.service import config as configuration
from t6gps.service.checks import Wanted
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor
from t6gps.service.logs import Role
from t6gps.service.pool.state import RunState
from t6gps.service.steering.watch import heeding
from t6gps.service.training import evaluation, loop, origin
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.training.loop import Observer
from t6gps.storage import catalog, checkpoint
from t6gps.storage.catalog import Run
from t6gps.storage.errors import LearnerDiedError, RunError

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


def begin(config: Config, root: Path, name: str | None, default: str, resume: bool, warn: Warn) -> Run:
    """The run of that name below `root`: a new one, or with `resume` the one that there is, if there is one.

    Without a name it is `default`, or without `resume` the first of default-2, default-3, ... that is free. RunError
    when the name is taken or refused, when the run to resume has another configuration, or when the root takes no more
    files. `warn` is told what made the run and is another now.
    """
    checks.require((checks.root_folder,), Wanted(config.run.workers, root))
    chosen = default if name is None else name
    if not (resume and catalog.exists(root, chosen)):
        return origin.create(config, root, chosen, numbered=name is None and not resume)
    run = catalog.open_run(root, chosen)
    tell_changes(run, warn)
    check_unchanged(run, config, "repeat the run's settings, or start a new run with --run")
    return run


def tell_changes(run: Run, warn: Warn) -> None:
    """Tell what made a run and is another now. RunError for a run of a later version."""
    sentence = origin.changes(run)
    if sentence is not None:
        warn(sentence)


def complete(config: Config, run: Run, serial: bool, observer: Observer) -> Evaluation:
    """Train what is missing of a run, evaluate its policy without noise, and keep the result.

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
        with closing(started) as executor:
            with heeding(run):
                result = train_and_evaluate(config, run, executor, observer)
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
    deaths_n, size = 0, config.run
    while True:
        loop.train(config, run, executor, observer)
        try:
            return evaluation.evaluate(config, executor, size.evaluation_episodes, size.seed, None, observer)
        except LearnerDiedError:
            deaths_n += 1
            if deaths_n > loop.LEARNER_DEATHS_ALLOWED_N:
                raise
            executor.replace_learner()


def evaluate_newest(run: Run, overrides: Sequence[str], serial: bool, observer: Observer) -> Evaluation:
    """Evaluate a run's newest policy in the world that `overrides` change, on the seeds of the run's own evaluation."""
    config = origin.configured(run, overrides)
    with closing(restored(config, run, serial)) as executor:
        size = config.run
        return evaluation.evaluate(config, executor, size.evaluation_episodes, size.seed, None, observer)


def evaluation_config(run: Run, overrides: Sequence[str], warn: Warn) -> Config:
    """A run's configuration in the world that `overrides` change. ConfigError for one that would change the policy.

    `warn` is told what made the run and is another now.
    """
    configuration.check_keys(overrides, "eval", EVALUATION_SECTIONS, "the policy is trained already")
    tell_changes(run, warn)
    return origin.configured(run, overrides)


def restored(config: Config, run: Run, serial: bool, engine: Engine = Engine.BULLET) -> Executor:
    """An executor whose learner is that of the run's newest checkpoint. RunError if there is none yet."""
    latest = checkpoint.load_latest(run.checkpoints)
    if latest is None:
        raise RunError(f"run {run.name} has no checkpoint yet; let it finish an iteration")
    executor = start_executor(config, serial, engine=engine)
    _, manifest, arrays = latest
    try:
        executor.learner.restore(cast(Manifest, manifest), arrays)
    except BaseException:
        executor.close()
        raise
    return executor

"""Laws of what owns a simulator: it is never two, and a closed one moves nothing."""

import copy
import pickle
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from t6gps.storage.errors import PhysicsError
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.ground.terrain import generate
from t6gps.workers.physics.bullet_engine import STEPPERS, PyBulletEngine
from t6gps.workers.physics.engine import Unique
from t6gps.workers.physics.limits import physics_steps_n
from t6gps.workers.physics.mujoco_engine import MujocoEngine, MujocoStepper
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.settings import RobotSettings, RolloutSettings
from t6gps.workers.worker import RolloutWorker

ROBOT = RobotSettings()


@pytest.fixture(scope="module")
def owners() -> Iterator[list[object]]:
    """One of everything that leads to a simulator."""
    engine, worker = PyBulletEngine(ROBOT), RolloutWorker(RolloutSettings())
    yield [
        engine,
        worker,
        MujocoEngine(ROBOT),
        MujocoStepper(ROBOT, None),
        RunningEpisode(engine, RolloutSettings(), 1, 1, 0.0, nominal_rest_length(ROBOT)),
        *(STEPPERS[name](engine.client, ROBOT, physics_steps_n(ROBOT)) for name in ("plugin", "reference")),
    ]
    worker.close()
    engine.close()


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_nothing_that_owns_a_simulator_can_be_copied(owners: list[object], copied: Callable[[object], object]) -> None:
    for owner in owners:
        assert isinstance(owner, Unique)
        with pytest.raises(PhysicsError, match=f"{type(owner).__name__} cannot be copied or pickled"):
            copied(owner)


def test_a_closed_engine_refuses_every_use_and_leaves_the_next_one_alone() -> None:
    """PyBullet gives the number of a closed client to the next one."""
    closed = PyBulletEngine(ROBOT)
    client = closed.client
    closed.close()
    closed.close()
    with PyBulletEngine(ROBOT) as engine:
        assert engine.client == client
        before = engine.state()
        state = neutral_state(ROBOT, 3.0)
        uses: list[Callable[[], object]] = [
            lambda: closed.client,
            lambda: closed.reset(state),
            lambda: closed.set_ground(None),
            lambda: closed.set_ground(generate(1, 1.0)),
            lambda: closed.control_step(state.rest_lengths),
        ]
        for use in uses:
            with pytest.raises(PhysicsError, match="closed"):
                use()
        assert np.array_equal(engine.control_step(before.rest_lengths).bars, after_one_step(before.rest_lengths))


def after_one_step(command: np.ndarray) -> np.ndarray:
    """Bars of an engine of its own after one control step from its start."""
    with PyBulletEngine(ROBOT) as engine:
        return engine.control_step(command).bars

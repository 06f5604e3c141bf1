"""A rollout worker: owns one simulated robot and runs plans."""

from __future__ import annotations

from collections.abc import Callable

from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N, SENSORS_N
from t6gps.workers.episode import policy, streams
from t6gps.workers.episode.randomisation import draw
from t6gps.workers.episode.recording import Record
from t6gps.workers.episode.rollout import Controller, controlled, rollout
from t6gps.workers.episode.stance import check_stance
from t6gps.workers.episode.streams import Stream
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Engine, Unique
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings, RolloutSettings

LAST_STATES_N = 5
"""Half a second: enough to see where a failed episode was heading."""


class RolloutWorker(Unique):
    """Runs episodes one after the other; each depends on its plan and policy alone.

    `engine` makes the simulator of a robot: PyBullet, or another engine. Raises PhysicsError for a robot that cannot
    stand, and TerrainError for a file that is no ground.
    """

    def __init__(self, settings: RolloutSettings, engine: Callable[[RobotSettings], Engine] = PyBulletEngine) -> None:
        check_stance(settings)
        self._settings = settings
        self._make_engine = engine
        self._engine = engine(settings.robot)
        self._record = Record()

    def run(self, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
        """Run one episode. DataError if the policy does not fit the robot, PhysicsError if the start is unsound."""
        policy.check(snapshot, (SENSORS_N, OBSERVATION_N), CABLES_N)
        settings, delay_steps = self._prepare(plan)
        return rollout(self._engine, settings, plan, snapshot, delay_steps, self._record)

    def drive(self, plan: EpisodePlan, control: Controller, version: int, nominal_m: float) -> Episode:
        """Run one episode under any controller; arguments are those of `rollout.controlled`, errors those of `run`."""
        settings, delay_steps = self._prepare(plan)
        return controlled(self._engine, settings, plan, control, version, nominal_m, delay_steps, self._record)

    def _prepare(self, plan: EpisodePlan) -> tuple[RolloutSettings, int]:
        """The settings of an episode, whose robot the engine then has, and its control delay (control steps)."""
        self._record = Record()
        rng = streams.generator(plan.seed, Stream.ROBOT)
        robot, delay_steps = draw(self._settings.robot, self._settings.randomisation, rng)
        if robot != self._engine.robot:
            self._engine.close()
            self._engine = self._make_engine(robot)
        return self._settings.model_copy(update={"robot": robot}), delay_steps

    def position(self) -> tuple[int, list[dict[str, object]]]:
        """Control step of the newest episode, and its last states: where it stands, or where it failed."""
        states = self._record.states[-LAST_STATES_N:]
        return len(self._record.actions), [
            {name: values.tolist() for name, values in state.parts().items()} for state in states
        ]

    def close(self) -> None:
        """Release the simulator."""
        self._engine.close()

"""The robot and its task as a Gymnasium environment, for any library of reinforcement learning (docs/environment.md).

Importing this module registers `t6gps/SuperBall-v0`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from operator import index
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

try:
    import gymnasium
except ModuleNotFoundError as error:
    if error.name != "gymnasium":
        raise
    raise ModuleNotFoundError(
        "t6gps.workers.environment needs Gymnasium, which is not installed; run: pip install 't6gps[gym]'",
        name="gymnasium",
    ) from None

from t6gps.storage.errors import ConfigError, DataError, UnsoundStateError
from t6gps.storage.schema import OBSERVATION_N, REST_LENGTH_SCALE_M, SENSORS_N
from t6gps.storage.settings import Settings
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.episode.stance import check_stance
from t6gps.workers.episode.task import running_cost
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Unique
from t6gps.workers.physics.limits import FASTEST_SOUND_M_PER_S
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.observation import ANGULAR_VELOCITY_SCALE_RAD_PER_S, FARTHEST_NODE
from t6gps.workers.robot.symmetry import CABLE_MAP
from t6gps.workers.robot.topology import BAR_LENGTH_M, CABLES_N
from t6gps.workers.settings import RobotSettings, RolloutSettings, TaskSettings, TerrainSettings

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Floats = NDArray[np.float32]
Info = dict[str, Any]

ENVIRONMENT_ID = "t6gps/SuperBall-v0"
EPISODE_STEPS = 250
"""Control steps T after which Gymnasium truncates an episode (paper Sec. IV-A)."""


def _observation_space(robot: RobotSettings) -> gymnasium.spaces.Box[np.float32]:
    """The box [83] that no observation leaves; entries and scales are those of `observation`.

    Winches stay within the range of commands. A sound state bounds the root of the summed squares of all velocities,
    so also the angular velocity of each bar.
    """
    high = np.ones(OBSERVATION_N)
    low = -high
    low[0] = 0.0
    nominal_m = nominal_rest_length(robot)
    low[1:25] = (robot.shortest_command_m - nominal_m) / REST_LENGTH_SCALE_M
    high[1:25] = (robot.longest_command_m - nominal_m) / REST_LENGTH_SCALE_M
    high[25:43] = FASTEST_SOUND_M_PER_S / (BAR_LENGTH_M / 2) / ANGULAR_VELOCITY_SCALE_RAD_PER_S
    high[SENSORS_N:] = FARTHEST_NODE
    low[25:] = -high[25:]
    return gymnasium.spaces.Box(low.astype(np.float32), high.astype(np.float32))


class SuperBallEnvironment(Unique, gymnasium.Env[Floats, Floats]):
    """SUPERball v2 on its way along random waypoints (paper Sec. IV-A), one control step of 0.1 s per `step`.

    Observations [83] and actions [24] are canonical: as the policy of T6-GPS sees and commands them. Actions -1 and 1
    stand for the shortest and longest commanded rest length. The reward is minus the running cost of the state
    reached (m2/s2).

    Settings are groups, or mappings of their names to plain values, which `environment.spec.to_json()` can write.
    Raises ConfigError for settings that are none, PhysicsError for a robot that cannot stand, and TerrainError for a
    file that is no ground.
    """

    def __init__(
        self,
        robot: RobotSettings | Mapping[str, object] | None = None,
        task: TaskSettings | Mapping[str, object] | None = None,
        terrain: TerrainSettings | Mapping[str, object] | None = None,
    ) -> None:
        self._settings = _settings({"robot": robot, "task": task, "terrain": terrain})
        self._middle_m = (self._settings.robot.longest_command_m + self._settings.robot.shortest_command_m) / 2
        self._half_range_m = (self._settings.robot.longest_command_m - self._settings.robot.shortest_command_m) / 2
        self.observation_space = _observation_space(self._settings.robot)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (CABLES_N,))
        check_stance(self._settings)
        self._engine = PyBulletEngine(self._settings.robot)
        self._closed = False
        self._episode: RunningEpisode | None = None

    def reset(self, *, seed: int | None = None, options: Info | None = None) -> tuple[Floats, Info]:
        """Start an episode. `seed` decides start, course and ground; without it they are drawn.

        The option `terrain_seed` sets the ground apart from the rest, as the plan of a recorded episode does. `info`
        names both seeds. DataError if there are other options or a seed is no whole number from 0 on, PhysicsError if
        the robot cannot start, TerrainError if the ground's file is none any more, and ClosedEnvironmentError of
        Gymnasium after `close`.
        """
        self._check_open()
        options = {} if options is None else options
        if not isinstance(options, Mapping):
            raise DataError(f"options of reset are a mapping such as {{'terrain_seed': 3}}, found {options!r}")
        if options.keys() - {"terrain_seed"}:
            raise DataError(f"reset takes no options but terrain_seed, found {', '.join(map(str, options))}")
        seed = None if seed is None else _seed(seed, "seed")
        chosen = _seed(options["terrain_seed"], "terrain_seed") if "terrain_seed" in options else None
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**63))
        terrain_seed = seed if chosen is None else chosen
        self._episode = None  # a start that fails leaves none
        settings = self._settings
        nominal_m = nominal_rest_length(settings.robot)
        episode = RunningEpisode(
            self._engine, settings, seed, terrain_seed, settings.terrain.difficulty, nominal_m, number=seed
        )
        self._episode = episode
        return episode.observation, {"seed": seed, "terrain_seed": terrain_seed, **_info(episode)}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, Info]:
        """Command the rest lengths that `action` [24] stands for during one control step.

        Where the simulation leaves the range of sound states, the episode terminates, `info["ended_by"]` says why,
        the last sound observation comes again, and the reward is that of standing still for EPISODE_STEPS steps, so
        that ending early never pays. DataError if the action is not 24 finite numbers, ResetNeeded and
        ClosedEnvironmentError of Gymnasium where no episode is running.
        """
        self._check_open()
        episode = self._episode
        if episode is None:
            raise gymnasium.error.ResetNeeded("the episode is over or has not begun; call reset() before step()")
        action = np.asarray(action)
        if action.shape != (CABLES_N,) or not np.isfinite(action).all():
            raise DataError(f"an action is {CABLES_N} finite numbers from -1 to 1, found {action!r}")
        # Recorded actions are float32; so are these, and a recorded episode can be repeated to the last bit.
        canonical = (self._middle_m + self._half_range_m * action.astype(np.float64)).astype(np.float32)
        try:
            episode.advance(canonical[CABLE_MAP[episode.frame.element]].astype(np.float64))
        except UnsoundStateError as error:
            self._episode = None
            unsound = -EPISODE_STEPS * self._settings.task.target_speed_m_per_s**2
            return episode.observation, unsound, True, False, {"ended_by": error.reason, **_info(episode)}
        reward = -float(running_cost(episode.state.com_velocity, np.array(episode.target), self._settings.task))
        return episode.observation, reward, False, False, _info(episode)

    def close(self) -> None:
        """Release the simulator; a second call does nothing."""
        self._closed = True
        self._episode = None
        self._engine.close()

    def _check_open(self) -> None:
        if self._closed:
            raise gymnasium.error.ClosedEnvironmentError("the environment was closed; make another one")


def _info(episode: RunningEpisode) -> Info:
    return {
        "forward_speed_m_per_s": float(episode.state.com_velocity[:2] @ np.array(episode.target)),
        "waypoints_reached": episode.course.reached,
        "com_m": episode.state.com,
        "face": episode.frame.face,
    }


def _seed(value: object, name: str) -> int:
    """A whole number from 0 on, of Python or numpy. DataError for anything else, True and False among it."""
    try:
        seed = -1 if isinstance(value, bool | np.bool_) else index(value)  # type: ignore[arg-type]
    except TypeError:
        seed = -1
    if seed < 0:
        raise DataError(f"{name} must be a whole number from 0 on, found {value!r}")
    return seed


def _settings(groups: Mapping[str, Settings | Mapping[str, object] | None]) -> RolloutSettings:
    """These groups of settings, defaults for those that are None. ConfigError for a key or value that is none."""
    values = {}
    for name, group in groups.items():
        kind = type(getattr(RolloutSettings(), name))
        if not isinstance(group, kind | Mapping | None):
            raise ConfigError(f"{name} must be {kind.__name__} or a mapping, found {group!r}")
        if group is not None:
            values[name] = group.model_dump(mode="json") if isinstance(group, Settings) else dict(group)
    try:
        return RolloutSettings.model_validate_json(json.dumps(values))
    except TypeError as error:
        raise ConfigError(f"{', '.join(values)}: {error}; use plain numbers, texts and lists") from None
    except ValidationError as error:
        raise ConfigError("; ".join(_sentence(item) for item in error.errors())) from None


def _sentence(item: ErrorDetails) -> str:
    message = item["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    if not item["loc"]:
        return message
    group, *names = map(str, item["loc"])
    if item["type"] == "extra_forbidden":
        allowed = getattr(RolloutSettings(), group).model_dump()
        return f"unknown key {'.'.join([group, *names])}; allowed in {group}: {', '.join(allowed)}"
    return f"{'.'.join([group, *names])}: {message}, found {item['input']!r}"


gymnasium.register(ENVIRONMENT_ID, f"{__name__}:{SuperBallEnvironment.__name__}", max_episode_steps=EPISODE_STEPS)

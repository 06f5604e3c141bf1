"""Speed of the physics, measured against references in the same run."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from importlib.util import find_spec
from itertools import pairwise

import numpy as np
from numpy.random import Generator

from t6gps.storage.errors import PhysicsError
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N
from t6gps.workers.episode.rollout import rollout
from t6gps.workers.ground.terrain import Terrain, generate
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.bullet_hooks import overrides
from t6gps.workers.physics.bullet_world import apply_loads, read_state
from t6gps.workers.physics.cables import move_winches
from t6gps.workers.physics.engine import CONTROL_STEP_S, Engine
from t6gps.workers.robot.neutral import neutral_state, nominal_rest_length
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings, RolloutSettings

_STEPS_N = 40
"""Some 20 ms: long beside the clock's resolution, short beside what else a machine does."""

_WARM_UP_STEPS_N = 15
"""The robot has fallen onto the ground."""


def _seconds(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def _reference_control_step(client: int, bodies: list[int], start: RobotState, command: Array) -> tuple[float, float]:
    """Seconds of a control step of the reference, and of its calls of stepSimulation alone."""
    robot = RobotSettings()
    rest_lengths, bare_s = start.rest_lengths, 0.0
    begin = time.perf_counter()
    for _ in range(round(CONTROL_STEP_S / robot.physics_step_s)):
        state = move_winches(read_state(client, bodies, rest_lengths), command, robot)
        apply_loads(client, bodies, state, robot)
        rest_lengths = state.rest_lengths
        bare_s += _seconds(partial(pybullet.stepSimulation, physicsClientId=client))
    return time.perf_counter() - begin, bare_s


class _TimedEngine(Engine):
    """Another engine, with the seconds that its control steps took, and those of making the ground."""

    def __init__(self, engine: Engine) -> None:
        self.robot, self._engine = engine.robot, engine
        self.steps_s = self.ground_s = 0.0

    def set_ground(self, terrain: Terrain | None) -> None:
        start = time.perf_counter()
        self._engine.set_ground(terrain)
        self.ground_s += time.perf_counter() - start

    def reset(self, state: RobotState) -> None:
        self._engine.reset(state)

    def state(self) -> RobotState:
        return self._engine.state()

    def control_step(self, command: Array) -> RobotState:
        start = time.perf_counter()
        state = self._engine.control_step(command)
        self.steps_s += time.perf_counter() - start
        return state

    def close(self) -> None:
        self._engine.close()


def episode_overhead(repeats: int = 9) -> dict[str, float]:
    """What an episode of 250 control steps costs beside its control steps, as shares of them; median over episodes.

    episode_overhead_share, rough_episode_overhead_share    on the plane, and on the paper's ground: start, frames,
                                                            observation, policy (3 x 128 units), recording
    rough_ground_share                                      making that ground in Bullet, once in an episode
    """
    settings = RolloutSettings()
    rng = np.random.default_rng(0)
    widths = [OBSERVATION_N, 128, 128, 128, CABLES_N]
    layers = tuple(
        ((rng.standard_normal((b, a)) / np.sqrt(a)).astype(np.float32), np.zeros(b, dtype=np.float32))
        for a, b in pairwise(widths)
    )
    snapshot = PolicySnapshot(0, layers, nominal_rest_length(settings.robot), 0.2)
    shares: dict[float, list[tuple[float, float]]] = {0.0: [], 1.0: []}
    with _TimedEngine(PyBulletEngine(settings.robot)) as engine:
        for difficulty, measured in shares.items():
            for seed in range(repeats + 1):
                plan = EpisodePlan(seed, 0, seed, seed, 250, seed, difficulty, 0.15, 0)
                engine.steps_s = engine.ground_s = 0.0
                total_s = _seconds(partial(rollout, engine, settings, plan, snapshot))
                steps_s, ground_s = engine.steps_s, engine.ground_s
                measured.append(((total_s - steps_s - ground_s) / steps_s, ground_s / steps_s))
    flat, rough = (np.median(measured[1:], axis=0) for measured in shares.values())  # the first one warms up
    return {
        "episode_overhead_share": float(flat[0]),
        "rough_episode_overhead_share": float(rough[0]),
        "rough_ground_share": float(rough[1]),
    }


def physics() -> dict[str, float]:
    """Everything that `t6gps bench physics` reports; MuJoCo takes part where it is installed.

    contacts_override_active, solver_override_active    1 where the hook into Bullet is active in this process, 0 where
                                                        it is not (docs/bullet-hooks.md)
    """
    result = physics_speed() | episode_overhead()
    result |= {f"{name}_override_active": float(is_active) for name, is_active in overrides.active().items()}
    if find_spec("mujoco") is not None:
        from t6gps.workers.bench.mujoco import mujoco_speed

        result |= mujoco_speed()
    return result


def physics_speed(repeats: int = 30) -> dict[str, float]:
    """Medians over rounds of 40 control steps under uniformly random commands, one core, everything interleaved.

    flat_steps_per_s, rough_steps_per_s    control steps per second; rough is the paper's ground, another one each round
                                           (grounds differ by half), and the clock starts after the fall onto it
    flat_speedup_over_reference            time of the plain Python law over that of the plugin, same motion
    flat_cost_over_bare_step               time of the plugin's control steps over that of as many stepSimulation calls
                                           from Python in the same motion (those made by the plain Python law)
    rough_cost_over_flat                   time of a rough control step over that of a flat one

    Raises PhysicsError if plugin and plain law do not end in the same state.
    """
    robot, rng = RobotSettings(), np.random.default_rng(0)
    with (
        PyBulletEngine(robot, "plugin") as flat,
        PyBulletEngine(robot, "plugin") as rough,
        PyBulletEngine(robot, "reference") as plain,
    ):
        _timed_round(flat, rough, plain, 0, _WARM_UP_STEPS_N, rng)
        rounds = [_timed_round(flat, rough, plain, number, _STEPS_N, rng) for number in range(1, repeats + 1)]
    times = {name: np.array([seconds[name] for seconds in rounds]) for name in rounds[0]}
    return {
        "flat_steps_per_s": float(_STEPS_N / np.median(times["flat"])),
        "rough_steps_per_s": float(_STEPS_N / np.median(times["rough"])),
        "flat_speedup_over_reference": float(np.median(times["reference"] / times["flat"])),
        "flat_cost_over_bare_step": float(np.median(times["flat"] / times["bare"])),
        "rough_cost_over_flat": float(np.median(times["rough"] / times["flat"])),
    }


def _timed_round(
    flat: PyBulletEngine, rough: PyBulletEngine, plain: PyBulletEngine, number: int, steps_n: int, rng: Generator
) -> dict[str, float]:
    """Seconds of `steps_n` control steps: "flat", "rough", "reference" and "bare", on rough ground number `number`."""
    robot = flat.robot
    low, high = robot.shortest_command_m, robot.longest_command_m
    round_s = dict.fromkeys(("flat", "rough", "reference", "bare"), 0.0)
    rough.set_ground(generate(number, 1.0))
    rough.reset(neutral_state(robot, 1.8))
    for command in rng.uniform(low, high, (_WARM_UP_STEPS_N, CABLES_N)):
        rough.control_step(command)
    start = flat.state()
    flat.reset(start)
    plain.reset(start)
    for command in rng.uniform(low, high, (steps_n, CABLES_N)):
        reference_s, bare_s = _reference_control_step(plain.client, plain.bodies, flat.state(), command)
        round_s["reference"] += reference_s
        round_s["bare"] += bare_s
        round_s["flat"] += _seconds(partial(flat.control_step, command))
        round_s["rough"] += _seconds(partial(rough.control_step, command))
    end = read_state(plain.client, plain.bodies, flat.state().rest_lengths)
    if not np.array_equal(flat.state().bar_positions, end.bar_positions):
        raise PhysicsError("the plugin and the plain law end in different states; rebuild the plugin")
    return round_s

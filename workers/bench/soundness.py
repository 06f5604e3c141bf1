"""How far random motion goes at the limits of what the settings allow: nothing may leave the range of sound states."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from t6gps.storage.errors import UnsoundStateError
from t6gps.workers.episode.start import random_start
from t6gps.workers.ground.terrain import generate
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.topology import CABLES, CABLES_N
from t6gps.workers.settings import RobotSettings

EPISODE_STEPS = 250
"""Control steps T of an episode (paper Sec. IV-A)."""

_WIDEST = RobotSettings(shortest_command_m=0.4, longest_command_m=1.6, winch_speed_m_per_s=2.0)
EXTREME_ROBOTS = tuple(
    _WIDEST.model_copy(update=extreme)
    for extreme in (
        {},
        {"cable_stiffness_n_per_m": 5000.0},
        {"cable_stiffness_n_per_m": 500.0},
        {"friction": 1.5},
        {"friction": 0.05},
    )
)
"""Robots with the widest range of commands and the fastest winches, at the ends of stiffness and friction."""


def extremes(robot: RobotSettings, seeds: Iterable[int]) -> dict[str, float]:
    """Extremes over episodes of 25 s under uniformly random commands on the roughest ground, one per seed.

    unsound_episodes            episodes that left the range of sound states, or could not start
    lowest_node_m               least height of a node above the ground (m); a node is the centre of a bar's cap
    fastest_com_m_per_s, fastest_spin_rad_per_s, longest_cable_m
    """
    unsound, lowest_m = 0, np.inf
    largest = np.zeros(3)
    with PyBulletEngine(robot) as engine:
        for seed in seeds:
            rng, ground = np.random.default_rng(seed), generate(seed, 1.0)
            engine.set_ground(ground)
            try:
                random_start(engine, robot, ground, rng)
                for _ in range(EPISODE_STEPS):
                    command = rng.uniform(robot.shortest_command_m, robot.longest_command_m, CABLES_N)
                    state = engine.control_step(command)
                    nodes = state.nodes()
                    lowest_m = min(lowest_m, (nodes[:, 2] - ground.height(nodes[:, 0], nodes[:, 1])).min())
                    reached = (
                        np.linalg.norm(state.com_velocity),
                        np.linalg.norm(state.bar_angular_velocities, axis=1).max(),
                        np.linalg.norm(nodes[CABLES[:, 0]] - nodes[CABLES[:, 1]], axis=1).max(),
                    )
                    largest = np.maximum(largest, reached)
            except UnsoundStateError:
                unsound += 1
    return {
        "unsound_episodes": unsound,
        "lowest_node_m": float(lowest_m),
        "fastest_com_m_per_s": float(largest[0]),
        "fastest_spin_rad_per_s": float(largest[1]),
        "longest_cable_m": float(largest[2]),
    }


def soundness(episodes: int = 500) -> dict[str, float]:
    """`extremes` over EXTREME_ROBOTS, `episodes` in all: what `t6gps bench soundness` reports."""
    seeds = range(episodes // len(EXTREME_ROBOTS))
    each = [extremes(robot, seeds) for robot in EXTREME_ROBOTS]
    result = {key: max(figures[key] for figures in each) for key in each[0]}
    result["unsound_episodes"] = sum(figures["unsound_episodes"] for figures in each)
    result["lowest_node_m"] = min(figures["lowest_node_m"] for figures in each)
    return {"episodes": len(seeds) * len(each), **result}

"""The binding of native/stepper.c, which computes the law of physics/cables.py inside Bullet."""

from __future__ import annotations

from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import numpy as np

from t6gps.storage.errors import PhysicsError
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.cables import winch_steps
from t6gps.workers.physics.engine import Unique
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BARS_N, CABLES, CABLES_N
from t6gps.workers.settings import RobotSettings

_REMEDY = "reinstall t6gps and pybullet 3.2.7, or set T6GPS_PHYSICS=reference (slower, same results)"
_FAILURES = {
    1: "it is not bound to its data",
    2: "it was built for another layout of the shared data",
    3: "the library of the pybullet module is not open",
    4: "pybullet lacks the function {missing}",
    5: "out of memory",
    6: "Bullet refused to give the state of a bar",
}
_BLOCK = np.dtype(
    [
        ("winch_steps_m", "f8", CABLES_N),
        ("stall", "f8"),
        ("stiffness", "f8"),
        ("damping", "f8"),
        ("max_tension", "f8"),
        ("axial_damping", "f8"),
        ("span", "f8"),
        ("command", "f8", CABLES_N),
        ("rest", "f8", CABLES_N),
        ("bars", "f8", (BARS_N, 13)),
        ("bodies", "i4", BARS_N),
        ("cables", "i4", (CABLES_N, 2)),
        ("steps_n", "i4"),
        ("unused", "i4"),
        ("missing", "S64"),
    ]
)


def library_path(folder: Path = Path(__file__).parent) -> Path:
    """The compiled plugin in `folder`. Raises PhysicsError if it was not built."""
    candidates = [folder / f"_stepper{suffix}" for suffix in EXTENSION_SUFFIXES]
    for candidate in candidates:
        if candidate.exists():
            return candidate
    raise PhysicsError(f"the physics plugin {candidates[0].name} is not built; {_REMEDY}")


class PluginStepper(Unique):
    """Steps a client by one call per control step; the numbers are exchanged in one block of memory.

    Bullet's functions are looked up in `bullet_library`, which the process must have loaded.
    """

    def __init__(
        self, client: int, robot: RobotSettings, steps_n: int, bullet_library: str = pybullet.__file__
    ) -> None:
        self._client = client
        self._block = np.zeros((), _BLOCK)
        self._block["winch_steps_m"] = winch_steps(robot)
        self._block["stall"] = robot.winch_stall_n or 0.0
        self._block["stiffness"] = robot.cable_stiffness_n_per_m
        self._block["damping"] = robot.cable_damping_n_s_per_m
        self._block["max_tension"] = robot.cable_max_tension_n
        self._block["axial_damping"] = robot.axial_damping_n_m_s
        self._block["span"] = robot.attachment_span_m
        self._block["cables"] = CABLES
        self._block["steps_n"] = steps_n
        path = library_path()
        self._plugin = pybullet.loadPlugin(str(path), "_t6gps", physicsClientId=client)
        if self._plugin < 0:
            raise PhysicsError(f"Bullet cannot load the physics plugin {path}; {_REMEDY}")
        address = self._block.ctypes.data
        halves = np.array([address & 0xFFFFFFFF, address >> 32], dtype=np.uint32).view(np.int32)
        self._call(bullet_library, [_BLOCK.itemsize, *halves.tolist()])

    def _call(self, text: str, integers: list[int]) -> None:
        result = pybullet.executePluginCommand(self._plugin, text, intArgs=integers, physicsClientId=self._client)
        if result != 0:
            missing = bytes(self._block["missing"]).decode()
            reason = _FAILURES.get(result, f"unknown result {result}").format(missing=missing)
            raise PhysicsError(f"the physics plugin failed: {reason}; {_REMEDY}")

    def control_step(self, bodies: list[int], rest_lengths: Array, command: Array) -> RobotState:
        """State after one control step under `command` [24] (m)."""
        block = self._block
        block["bodies"], block["rest"], block["command"] = bodies, rest_lengths, command
        self._call("", [])
        return RobotState(block["bars"].copy(), block["rest"].copy())

"""The robot in PyBullet: six capsules, 24 cables, one ground.

Sources of the parameters and the choices of the simulation: docs/physics.md; the hooks into Bullet:
docs/bullet-hooks.md.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Protocol

import numpy as np

from t6gps.storage.errors import PhysicsError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.bullet_hooks import overrides
from t6gps.workers.physics.bullet_hooks.plugin import PluginStepper
from t6gps.workers.physics.bullet_world import build_world, place_bars, read_state
from t6gps.workers.physics.engine import Engine
from t6gps.workers.physics.limits import check_sound, clipped, physics_steps_n
from t6gps.workers.physics.reference import ReferenceStepper
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.settings import RobotSettings

STEPPER_VARIABLE = "T6GPS_PHYSICS"
"""Environment variable that chooses among STEPPERS."""


class Stepper(Protocol):
    """Moves the bars of a client by control steps."""

    def control_step(self, bodies: list[int], rest_lengths: Array, command: Array) -> RobotState:
        """State after one control step of these bars, from these rest lengths [24] under `command` [24] (m)."""


PLUGIN = "plugin"
REFERENCE = "reference"
BULLET = "bullet"
STEPPERS: dict[str, Callable[[int, RobotSettings, int], Stepper]] = {
    PLUGIN: PluginStepper,
    REFERENCE: ReferenceStepper,
    BULLET: ReferenceStepper,
}
"""Steppers by name: all hooks (fast), the overrides alone (same results), and Bullet without any hook."""


class PyBulletEngine(Engine):
    """One PyBullet client with the robot and its ground.

    `stepper` is one of STEPPERS; by default the environment variable T6GPS_PHYSICS decides, else "plugin". `client` and
    `bodies` are PyBullet's numbers of the client and of the six bars. Raises PhysicsError if the physics cannot be
    started, and wherever an engine is used that was closed: its number may be another one's by then.
    """

    def __init__(self, robot: RobotSettings, stepper: str | None = None) -> None:
        name = stepper or os.environ.get(STEPPER_VARIABLE, PLUGIN)
        if name not in STEPPERS:
            raise PhysicsError(f"{STEPPER_VARIABLE} must be one of {', '.join(STEPPERS)}, got {name!r}")
        steps_n = physics_steps_n(robot)
        if name == BULLET:
            _check_bare()
        else:
            overrides.take_over()
        self.robot = robot
        self.bodies: list[int] = []
        self._terrain: Terrain | None = None
        self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise PhysicsError("PyBullet cannot open another client; close simulations that are no longer used")
        try:
            self._stepper = STEPPERS[name](self.client, robot, steps_n)
            self.set_ground(None)
        except BaseException:
            self.close()
            raise

    @property
    def client(self) -> int:
        """PyBullet's number of the client. PhysicsError if it was closed."""
        self._check_open()
        return self._client

    def _check_open(self) -> None:
        if self._client < 0:
            raise PhysicsError("the engine was closed, and its simulator with it; make a new one")

    def set_ground(self, terrain: Terrain | None) -> None:
        """Replace the ground, None being the plane z = 0, and put the robot into its neutral state.

        The whole world is rebuilt: what Bullet computes depends on the order in which bodies were made. A plane in
        place of a plane is the same world.
        """
        client = self.client
        if not self.bodies or terrain is not None or self._terrain is not None:
            self._terrain = terrain
            self.bodies = build_world(client, self.robot, terrain)
        self.reset(neutral_state(self.robot))

    def reset(self, state: RobotState) -> None:
        """Put bars and rest lengths where `state` says, and forget all contacts of the past."""
        place_bars(self.client, self.bodies, state)
        self._state = read_state(self.client, self.bodies, np.array(state.rest_lengths, dtype=float))

    def state(self) -> RobotState:
        """The present state."""
        return self._state

    def control_step(self, command: Array) -> RobotState:
        """The state 0.1 s later, as `Engine.control_step` describes it."""
        within = clipped(command, self.robot)
        self._check_open()
        self._state = self._stepper.control_step(self.bodies, self._state.rest_lengths, within)
        check_sound(self._state, self._terrain)
        return self._state

    @contextmanager
    def branching(self) -> Iterator[Callable[[], None]]:
        """Gives a function that brings back the present state as often as it is called, contacts included.

        `reset` cannot: a state does not say which contacts it has. The end of the context brings it back, too.
        """
        saved, state = pybullet.saveState(physicsClientId=self.client), self._state

        def back() -> None:
            pybullet.restoreState(saved, physicsClientId=self.client)
            self._state = state

        try:
            yield back
        finally:
            back()
            pybullet.removeState(saved, physicsClientId=self.client)

    def close(self) -> None:
        """Close the client; a second call does nothing."""
        if self._client >= 0:
            pybullet.disconnect(physicsClientId=self._client)
            self._client = -1


def _check_bare() -> None:
    """PhysicsError if this process has overrides: they hold for every client and stay until it ends."""
    active = [name for name, is_active in overrides.active().items() if is_active]
    if active:
        raise PhysicsError(
            f"{STEPPER_VARIABLE}={BULLET} asks for Bullet alone, but this process has overridden its "
            f"{' and its '.join(active)}; set the variable before the process starts its first engine"
        )

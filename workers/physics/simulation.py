"""The robot in PyBullet: six capsules, 24 cables, one ground, advanced by control steps of 0.1 s.

Sources of the parameters and the choices of the simulation: docs/physics.md. The law of the cables:
workers/physics/reference.py.
"""

from __future__ import annotations

import os
from functools import cache
from math import isfinite
from typing import Protocol, Self

import numpy as np

from t6gps.storage.errors import PhysicsError, UnsoundStateError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.bullet_hooks.overrides import take_over
from t6gps.workers.physics.bullet_hooks.plugin import PluginStepper
from t6gps.workers.physics.observer import extremes
from t6gps.workers.physics.reference import ReferenceStepper, read_state
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS, BARS_N, CABLE_LENGTH_M, CABLES_N, NODES_M
from t6gps.workers.settings import RobotSettings

CONTROL_STEP_S = 0.1
GRAVITY_M_PER_S2 = 9.81
STEPPER_VARIABLE = "T6GPS_PHYSICS"

FASTEST_SOUND_M_PER_S = 60.0
_DEEPEST_SOUND_M = 0.3
_PARKING_HEIGHT_M = 1000.0


class _Stepper(Protocol):
    def __init__(self, client: int, robot: RobotSettings, steps_n: int) -> None: ...

    def control_step(self, bodies: list[int], rest_lengths: Array, command: Array) -> RobotState: ...


_STEPPERS: dict[str, type[_Stepper]] = {"plugin": PluginStepper, "reference": ReferenceStepper}


def nominal_rest_length(robot: RobotSettings) -> float:
    """Rest length (m) at which every cable of the neutral shape carries the pretension."""
    return CABLE_LENGTH_M - robot.pretension_n / robot.cable_stiffness_n_per_m


@cache
def neutral_state(robot: RobotSettings, height_m: float = BAR_LENGTH_M / 2 + 0.1) -> RobotState:
    """The neutral shape at rest, as in topology.NODES_M, with its centre at height `height_m` over the origin."""
    first, second = NODES_M[BARS[:, 0]], NODES_M[BARS[:, 1]]
    axes = (first - second) / BAR_LENGTH_M
    # The shortest rotation from z to an axis n is the normalised quaternion (z x n, 1 + z . n); no axis is -z.
    orientations = np.stack([-axes[:, 1], axes[:, 0], np.zeros(BARS_N), 1 + axes[:, 2]], axis=1)
    state = RobotState.of(
        (first + second) / 2 + [0.0, 0.0, height_m],
        orientations / np.linalg.norm(orientations, axis=1, keepdims=True),
        np.zeros((BARS_N, 3)),
        np.zeros((BARS_N, 3)),
        np.full(CABLES_N, nominal_rest_length(robot)),
    )
    for values in vars(state).values():
        values.setflags(write=False)  # every caller gets the same arrays
    return state


@cache
def _mesh_lists(points_n: int, cell_m: float) -> tuple[list[list[float]], list[int]]:
    """Lists to hand over the mesh of a square ground, all but its heights (vertices, vertex numbers of the triangles).

    PyBullet 3.2.7 never lets go of such lists, so the same ones serve every ground of this size.
    """
    vertices, faces = Terrain(np.zeros((points_n, points_n)), cell_m).triangles()
    return vertices.tolist(), faces.ravel().tolist()


class Simulation:
    """One PyBullet client with the robot and its ground. Several may live in one process.

    `stepper` is "plugin" (fast) or "reference" (plain Python, same results); by default the environment variable
    T6GPS_PHYSICS decides, else "plugin". `robot` are its settings, `client` and `bodies` PyBullet's numbers of
    the client and of the six bars. Raises PhysicsError if the physics cannot be started.
    """

    def __init__(self, robot: RobotSettings, stepper: str | None = None) -> None:
        name = stepper or os.environ.get(STEPPER_VARIABLE, "plugin")
        if name not in _STEPPERS:
            raise PhysicsError(f"{STEPPER_VARIABLE} must be one of {', '.join(_STEPPERS)}, got {name!r}")
        steps_n = round(CONTROL_STEP_S / robot.physics_step_s)
        if abs(steps_n * robot.physics_step_s - CONTROL_STEP_S) > 1e-9:
            raise PhysicsError(
                f"robot.physics_step_s must divide the control step of {CONTROL_STEP_S} s, "
                f"got {robot.physics_step_s}; choose for instance 0.001, 0.002, 0.004 or 0.005"
            )
        self.robot = robot
        self.bodies: list[int] = []
        self._terrain: Terrain | None = None
        take_over()
        self.client = pybullet.connect(pybullet.DIRECT)
        if self.client < 0:
            raise PhysicsError("PyBullet cannot open another client; close simulations that are no longer used")
        try:
            self._stepper: _Stepper = _STEPPERS[name](self.client, robot, steps_n)
            self.set_ground(None)
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the client; a second call does nothing."""
        if self.client >= 0:
            pybullet.disconnect(physicsClientId=self.client)
            self.client = -1

    def set_ground(self, terrain: Terrain | None) -> None:
        """Replaces the ground, None being the plane z = 0, and puts the robot into its neutral state.

        The whole world is rebuilt: what Bullet computes depends on the order in which bodies were made. A plane in
        place of a plane is the same world.
        """
        if self.bodies and terrain is None and self._terrain is None:
            self.reset(neutral_state(self.robot))
            return
        client = self.client
        pybullet.resetSimulation(physicsClientId=client)
        pybullet.setPhysicsEngineParameter(
            fixedTimeStep=self.robot.physics_step_s,
            numSubSteps=0,
            deterministicOverlappingPairs=1,
            physicsClientId=client,
        )
        pybullet.setGravity(0.0, 0.0, -GRAVITY_M_PER_S2, physicsClientId=client)
        self._terrain = terrain
        self._add_ground()
        self.bodies = [self._add_bar() for _ in range(BARS_N)]
        self.reset(neutral_state(self.robot))

    def _add_ground(self) -> None:
        client = self.client
        if self._terrain is None:
            shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
        else:
            vertices, indices = _mesh_lists(len(self._terrain.heights), self._terrain.cell_m)
            for vertex, height in zip(vertices, self._terrain.heights.ravel().tolist(), strict=True):
                vertex[2] = height
            shape = pybullet.createCollisionShape(
                pybullet.GEOM_MESH, vertices=vertices, indices=indices, physicsClientId=client
            )
        # A plain rigid body: as a multibody it would take part in every solver row, though it never moves.
        ground = pybullet.createMultiBody(0.0, shape, useMaximalCoordinates=1, physicsClientId=client)
        pybullet.changeDynamics(ground, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)

    def _add_bar(self) -> int:
        client, robot = self.client, self.robot
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_CAPSULE, radius=robot.bar_radius_m, height=BAR_LENGTH_M, physicsClientId=client
        )
        bar: int = pybullet.createMultiBody(robot.bar_mass_kg, shape, physicsClientId=client)
        transverse_inertia = robot.bar_mass_kg * BAR_LENGTH_M**2 / 12
        pybullet.changeDynamics(
            bar,
            -1,
            localInertiaDiagonal=[transverse_inertia, transverse_inertia, robot.axial_inertia_kg_m2],
            lateralFriction=robot.friction,
            restitution=0.0,
            linearDamping=0.0,
            angularDamping=0.0,
            jointDamping=0.0,
            activationState=pybullet.ACTIVATION_STATE_DISABLE_SLEEPING,
            physicsClientId=client,
        )
        return bar

    def reset(self, state: RobotState) -> None:
        """Puts bars and rest lengths where `state` says.

        The bars are first parked far apart for one collision pass, so that no contact of the past is remembered.
        """
        client = self.client
        for number, bar in enumerate(self.bodies):
            height = _PARKING_HEIGHT_M * (number + 1)
            pybullet.resetBasePositionAndOrientation(bar, [0, 0, height], [0, 0, 0, 1], physicsClientId=client)
        pybullet.performCollisionDetection(physicsClientId=client)
        for number, bar in enumerate(self.bodies):
            pybullet.resetBasePositionAndOrientation(
                bar, state.bar_positions[number], state.bar_orientations[number], physicsClientId=client
            )
            pybullet.resetBaseVelocity(
                bar,
                state.bar_velocities[number],
                state.bar_angular_velocities[number],
                physicsClientId=client,
            )
        self._state = read_state(client, self.bodies, np.array(state.rest_lengths, dtype=float))

    def state(self) -> RobotState:
        """The present state."""
        return self._state

    def control_step(self, command: Array) -> RobotState:
        """The state 0.1 s later, under commanded rest lengths [24] (m), clipped to the range of commands.

        Raises UnsoundStateError if the state leaves the range of sound ones: not finite, too fast (60 m/s), through the
        ground or beyond its sides. The simulation then needs a reset.
        """
        robot = self.robot
        wanted = np.minimum(np.maximum(command, robot.shortest_command_m), robot.longest_command_m)
        if wanted.shape != (CABLES_N,) or not isfinite(wanted.sum()):
            raise PhysicsError(f"a command is {CABLES_N} finite rest lengths (m), got {np.asarray(command)!r}")
        self._state = self._stepper.control_step(self.bodies, self._state.rest_lengths, wanted)
        self._check()
        return self._state

    def _check(self) -> None:
        state = self._state
        spin = BAR_LENGTH_M / 2 * state.bar_angular_velocities
        speed = np.sqrt(np.vdot(state.bar_velocities, state.bar_velocities) + np.vdot(spin, spin))
        if not speed < FASTEST_SOUND_M_PER_S:  # also true of a NaN
            raise UnsoundStateError(
                f"the six bars together move at {speed} m/s (root of the sum of squares), above "
                f"{FASTEST_SOUND_M_PER_S}: the simulation became unstable; "
                "use a smaller robot.physics_step_s or softer cables",
                reason="unstable",
            )
        if self._terrain is None:
            return  # the plane is a half-space: nothing passes through it
        side, depth = extremes(state, self._terrain)
        allowed = self._terrain.half_size_m
        if side > allowed:
            raise UnsoundStateError(
                f"a node is {side:.2f} m from the centre, beyond the ground's side at {allowed} m; "
                "use a larger ground or nearer waypoints",
                reason="beyond the ground",
            )
        if depth > _DEEPEST_SOUND_M:
            raise UnsoundStateError(
                f"a node is {depth:.2f} m below the ground, more than {_DEEPEST_SOUND_M}: a bar passed through it; "
                "use a smaller robot.physics_step_s or thicker bars",
                reason="through the ground",
            )

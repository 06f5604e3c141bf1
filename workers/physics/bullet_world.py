"""The robot and its ground in a PyBullet client: made, placed, loaded and read through PyBullet's Python interface."""

from __future__ import annotations

from functools import cache

import numpy as np

from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet import pybullet
from t6gps.workers.physics.cables import loads
from t6gps.workers.physics.engine import GRAVITY_M_PER_S2
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS_N
from t6gps.workers.settings import RobotSettings

PARKING_HEIGHT_M = 1000.0
"""Bars are parked at multiples of it: out of reach of the ground and of each other."""


def build_world(client: int, robot: RobotSettings, terrain: Terrain | None) -> list[int]:
    """Empty the client, make ground (None: the plane z = 0) and bars anew, and return the numbers of the six bars."""
    pybullet.resetSimulation(physicsClientId=client)
    pybullet.setPhysicsEngineParameter(
        fixedTimeStep=robot.physics_step_s,
        numSubSteps=0,
        deterministicOverlappingPairs=1,
        physicsClientId=client,
    )
    pybullet.setGravity(0.0, 0.0, -GRAVITY_M_PER_S2, physicsClientId=client)
    _add_ground(client, terrain)
    return [_add_bar(client, robot) for _ in range(BARS_N)]


def _add_ground(client: int, terrain: Terrain | None) -> None:
    if terrain is None:
        shape = pybullet.createCollisionShape(pybullet.GEOM_PLANE, physicsClientId=client)
    else:
        vertices, indices = _mesh_lists(len(terrain.heights), terrain.cell_m)
        for vertex, height in zip(vertices, terrain.heights.ravel().tolist(), strict=True):
            vertex[2] = height
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_MESH, vertices=vertices, indices=indices, physicsClientId=client
        )
    # A plain rigid body: as a multibody it would take part in every solver row, though it never moves.
    ground = pybullet.createMultiBody(0.0, shape, useMaximalCoordinates=1, physicsClientId=client)
    pybullet.changeDynamics(ground, -1, lateralFriction=1.0, restitution=0.0, physicsClientId=client)


@cache
def _mesh_lists(points_n: int, cell_m: float) -> tuple[list[list[float]], list[int]]:
    """Lists to hand over the mesh of a square ground, all but its heights (vertices, vertex numbers of the triangles).

    PyBullet 3.2.7 never lets go of such lists, so the same ones serve every ground of this size.
    """
    vertices, faces = Terrain(np.zeros((points_n, points_n)), cell_m).triangles()
    return vertices.tolist(), faces.ravel().tolist()


def _add_bar(client: int, robot: RobotSettings) -> int:
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


def place_bars(client: int, bodies: list[int], state: RobotState) -> None:
    """Put the bars where `state` says.

    They are first parked far apart for one collision pass, so that no contact of the past is remembered.
    """
    for number, bar in enumerate(bodies):
        height = PARKING_HEIGHT_M * (number + 1)
        pybullet.resetBasePositionAndOrientation(bar, [0, 0, height], [0, 0, 0, 1], physicsClientId=client)
    pybullet.performCollisionDetection(physicsClientId=client)
    for number, bar in enumerate(bodies):
        pybullet.resetBasePositionAndOrientation(
            bar, state.bar_positions[number], state.bar_orientations[number], physicsClientId=client
        )
        pybullet.resetBaseVelocity(
            bar,
            state.bar_velocities[number],
            state.bar_angular_velocities[number],
            physicsClientId=client,
        )


def read_state(client: int, bodies: list[int], rest_lengths: Array) -> RobotState:
    """State of the bars with these body numbers of a PyBullet client."""
    poses = [pybullet.getBasePositionAndOrientation(body, physicsClientId=client) for body in bodies]
    velocities = [pybullet.getBaseVelocity(body, physicsClientId=client) for body in bodies]
    return RobotState.of(
        np.array([position for position, _ in poses]),
        np.array([orientation for _, orientation in poses]),
        np.array([linear for linear, _ in velocities]),
        np.array([angular for _, angular in velocities]),
        rest_lengths,
    )


def apply_loads(client: int, bodies: list[int], state: RobotState, robot: RobotSettings) -> None:
    """Hand the loads of this state to Bullet; they act during the next physics step only."""
    forces, torques = loads(state, robot)
    for body, position, force, torque in zip(bodies, state.bar_positions, forces, torques, strict=True):
        pybullet.applyExternalForce(body, -1, force, position, pybullet.WORLD_FRAME, physicsClientId=client)
        pybullet.applyExternalTorque(body, -1, torque, pybullet.WORLD_FRAME, physicsClientId=client)

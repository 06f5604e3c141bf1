"""Messages of ROS 2 to what a policy measures, and its commands to a message (docs/policies.md).

Messages are taken by their fields, whichever library makes them: rclpy on a robot, rosbags in tests. All but the cables
are in the frame WORLD, z up, also the angular velocities, which an inertial unit measures in its own axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from t6gps.service.policies.driver import Array, Measurement
from t6gps.storage.errors import DataError
from t6gps.workers.robot.topology import BARS_N, CABLES_N, NODES_N

WORLD = "world"
"""The frame_id that a message must have."""
CABLES = tuple(f"cable_{number}" for number in range(CABLES_N))
"""Names of the cables in a JointState, in the order of `topology.CABLES`."""


class Header(Protocol):
    """std_msgs/Header."""

    frame_id: str


class Stamped(Protocol):
    """A message with a header."""

    header: Header


class Vector(Protocol):
    """geometry_msgs/Vector3 or Point."""

    x: float
    y: float
    z: float


class Pose(Protocol):
    """geometry_msgs/Pose."""

    position: Vector


class PoseArray(Stamped, Protocol):
    """geometry_msgs/PoseArray."""

    poses: Sequence[Pose]


class Twist(Protocol):
    """geometry_msgs/Twist."""

    linear: Vector


class TwistStamped(Stamped, Protocol):
    """geometry_msgs/TwistStamped."""

    twist: Twist


class Imu(Stamped, Protocol):
    """sensor_msgs/Imu."""

    angular_velocity: Vector


class PointStamped(Stamped, Protocol):
    """geometry_msgs/PointStamped."""

    point: Vector


class JointState(Protocol):
    """sensor_msgs/JointState."""

    name: Sequence[str]
    position: Sequence[float]


def measurement(
    nodes: PoseArray, com: TwistStamped, bars: Sequence[Imu], cables: JointState, waypoint: PointStamped
) -> Measurement:
    """What a policy measures, from the newest message of each kind.

    nodes      places of the 12 nodes
    com        velocity of the centre of mass
    bars       of each of the 6 bars its angular velocity
    cables     rest lengths as positions of joints of the names CABLES, in any order

    DataError for another frame, too few or too many, a cable that is missing, and a number that is not finite.
    """
    stamped: list[tuple[str, Stamped]] = [("nodes", nodes), ("com", com), ("waypoint", waypoint)]
    for what, message in stamped + [("bars", bar) for bar in bars]:
        if message.header.frame_id != WORLD:
            raise DataError(f"{what}: the frame_id must be {WORLD!r}, found {message.header.frame_id!r}; transform it")
    for what, found_n, wanted_n in (("nodes", len(nodes.poses), NODES_N), ("bars", len(bars), BARS_N)):
        if found_n != wanted_n:
            raise DataError(f"{what}: the robot has {wanted_n}, found {found_n}; send all of them")
    values = {
        "nodes": np.array([_row(pose.position) for pose in nodes.poses]),
        "com_velocity": _row(com.twist.linear),
        "bar_angular_velocities": np.array([_row(bar.angular_velocity) for bar in bars]),
        "rest_lengths": _rest_lengths(cables),
        "waypoint": _row(waypoint.point)[:2],
    }
    lost = [name for name, numbers in values.items() if not np.isfinite(numbers).all()]
    if lost:
        raise DataError(f"{', '.join(lost)}: every number must be finite; wait for the next message")
    return Measurement(**values)


def command(commands: Array) -> tuple[list[str], list[float]]:
    """Names and positions (m) of the JointState that commands the winches."""
    return list(CABLES), commands.tolist()


def _rest_lengths(cables: JointState) -> Array:
    if len(cables.name) != len(cables.position):
        raise DataError(f"cables: {len(cables.name)} names and {len(cables.position)} positions; send one for each")
    lengths = dict(zip(cables.name, cables.position, strict=True))
    missing = [name for name in CABLES if name not in lengths]
    if missing:
        raise DataError(f"cables: no position of {', '.join(missing)}; name joints {CABLES[0]} .. {CABLES[-1]}")
    return np.array([lengths[name] for name in CABLES], dtype=np.float64)


def _row(vector: Vector) -> Array:
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)

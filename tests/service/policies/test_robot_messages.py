"""Laws of the messages of ROS 2: what goes through a bag is measured as it was, and commands come back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from exported_policies import Material
from rosbags.rosbag2 import Reader, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from t6gps.service.policies import robot_messages
from t6gps.service.policies.driver import START, Measurement
from t6gps.service.policies.files import Format
from t6gps.storage.errors import DataError

STORE = get_typestore(Stores.ROS2_JAZZY)
NODES, COM, CABLES, WAYPOINT, COMMANDS = "/nodes", "/com", "/cables", "/waypoint", "/commands"
BARS = [f"/bar_{bar}" for bar in range(6)]


def message(kind: str, **fields: object) -> Any:
    """A message of a type of ROS, such as geometry_msgs/msg/Point."""
    return STORE.types[kind](**fields)


def header(frame_id: str = robot_messages.WORLD) -> Any:
    return message(
        "std_msgs/msg/Header", stamp=message("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id=frame_id
    )


def vector(values: np.ndarray[Any, Any], kind: str = "Vector3") -> Any:
    x, y, z = map(float, values)
    return message(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def joints(names: list[str], positions: list[float]) -> Any:
    none = np.empty(0)
    return message(
        "sensor_msgs/msg/JointState",
        header=header(),
        name=names,
        position=np.array(positions),
        velocity=none,
        effort=none,
    )


def messages(of: Measurement) -> dict[str, Any]:
    """What a robot would send, by topic; cables in an order of their own."""
    upright = message("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
    still, none = vector(np.zeros(3)), np.zeros(9)
    poses = [message("geometry_msgs/msg/Pose", position=vector(row, "Point"), orientation=upright) for row in of.nodes]
    twist = message("geometry_msgs/msg/Twist", linear=vector(of.com_velocity), angular=still)
    units = {
        topic: message(
            "sensor_msgs/msg/Imu",
            header=header(),
            orientation=upright,
            orientation_covariance=none,
            angular_velocity=vector(row),
            angular_velocity_covariance=none,
            linear_acceleration=still,
            linear_acceleration_covariance=none,
        )
        for topic, row in zip(BARS, of.bar_angular_velocities, strict=True)
    }
    place = vector(np.array([*of.waypoint, 0.0]), "Point")
    return {
        NODES: message("geometry_msgs/msg/PoseArray", header=header(), poses=poses),
        COM: message("geometry_msgs/msg/TwistStamped", header=header(), twist=twist),
        CABLES: joints(list(robot_messages.CABLES)[::-1], of.rest_lengths.tolist()[::-1]),
        WAYPOINT: message("geometry_msgs/msg/PointStamped", header=header(), point=place),
        **units,
    }


def mapped(sent: Mapping[str, Any]) -> Measurement:
    return robot_messages.measurement(
        sent[NODES], sent[COM], [sent[topic] for topic in BARS], sent[CABLES], sent[WAYPOINT]
    )


def through_bag(sent: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The messages after they were written to a bag in MCAP, and read from it."""
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        for time_ns, (topic, each) in enumerate(sent.items()):
            connection = bag.add_connection(topic, each.__msgtype__, typestore=STORE)
            bag.write(connection, time_ns, STORE.serialize_cdr(each, each.__msgtype__))
    with Reader(folder) as bag:
        return {
            connection.topic: STORE.deserialize_cdr(content, connection.msgtype)
            for connection, _, content in bag.messages()
        }


@pytest.fixture(scope="module")
def given() -> Measurement:
    rng = np.random.default_rng(0)
    sizes = ((12, 3), (3,), (6, 3), (24,), (2,))
    return Measurement(*(rng.standard_normal(size) for size in sizes))


def test_what_is_measured_and_commanded_survives_a_bag(given: Measurement, material: Material, tmp_path: Path) -> None:
    read = through_bag(messages(given), tmp_path / "measured")
    found = mapped(read)
    for name, values in vars(given).items():
        assert np.array_equal(getattr(found, name), values)
    driver = material.drivers[Format.C]
    commands, _ = driver.decide(found, START)
    assert np.array_equal(commands, driver.decide(given, START)[0])
    sent = through_bag({COMMANDS: joints(*robot_messages.command(commands))}, tmp_path / "commanded")[COMMANDS]
    assert sent.name == [f"cable_{number}" for number in range(24)]
    assert np.array_equal(sent.position, commands)


@pytest.mark.parametrize(
    ("topic", "changed", "words"),
    [
        (NODES, {"header": header("base_link")}, "nodes: the frame_id must be 'world', found 'base_link'"),
        (BARS[3], {"header": header("bar_3")}, "bars: the frame_id"),
        (NODES, {"poses": []}, "nodes: the robot has 12, found 0"),
        (CABLES, {"name": [f"winch_{number}" for number in range(24)]}, "no position of cable_0, "),
        (CABLES, {"name": ["cable_0"]}, "1 names and 24 positions"),
        (WAYPOINT, {"point": vector(np.array([np.nan, 0, 0]), "Point")}, "waypoint: every number must be finite"),
    ],
)
def test_a_message_that_does_not_fit_is_one_error(
    topic: str, changed: dict[str, Any], words: str, given: Measurement
) -> None:
    sent = messages(given)
    with pytest.raises(DataError, match=words):
        mapped({**sent, topic: replace(sent[topic], **changed)})

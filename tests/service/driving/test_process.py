"""Laws of the process of a drive: commands act after the step in which they come, and it ends with its input."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import closing
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from t6gps.service import config as configuration
from t6gps.service.driving import process
from t6gps.service.driving.commands import Command, Push
from t6gps.service.driving.field import Field
from t6gps.service.driving.order import Entrant, Order, order
from t6gps.storage import schema
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.driving import Start
from t6gps.workers.settings import RobotSettings, TerrainSettings

START = Start(1, 2, 0.0, 0)
WIDTHS = [schema.OBSERVATION_N, 16, 24]


def entrant(run: str, weight: float = 0.0) -> Entrant:
    """A policy that stands still."""
    layers = tuple((np.full((b, a), weight, np.float32), np.zeros(b, np.float32)) for a, b in pairwise(WIDTHS))
    return Entrant(run, 1, configuration.load("flat-quick").rollout, PolicySnapshot(1, layers, 1.088, 0.2))


def simulated(wanted: Order, *commands: Command) -> list[tuple[str, object]]:
    """What the process tells that is given all commands at once, and then nothing more."""
    lines = b"".join(command.model_dump_json().encode() + b"\n" for command in commands)
    given = process.written(60.0, wanted) + lines
    done = subprocess.run([sys.executable, "-m", process.__name__], input=given, stdout=subprocess.PIPE, check=True)
    parts = [line.partition(" ") for line in done.stdout.decode().splitlines()]
    return [(kind, json.loads(text)) for kind, _, text in parts]


def test_it_tells_the_scene_and_the_start_and_ends_with_its_input() -> None:
    told = simulated(order([entrant("a"), entrant("b")], START, None, 0.3))
    assert [kind for kind, _ in told[:2]] == ["scene", "frame"]
    scene, frame = told[0][1], told[1][1]
    assert isinstance(scene, dict)
    assert isinstance(frame, dict)
    assert (scene["friction"], scene["terrain_difficulty"], scene["ground"]) == (0.3, 0.0, None)
    assert [robot["run"] for robot in scene["robots"]] == ["a", "b"]
    assert (frame["start"], frame["time_s"], len(frame["robots"])) == (0, 0.0, 2)


def test_a_robot_that_cannot_be_driven_is_the_end_with_a_reason() -> None:
    told = simulated(order([entrant("a", weight=float("nan"))], START, None, None))
    assert told[-1][0] == "end"
    assert "must hold finite float32 numbers" in str(told[-1][1])


def test_each_of_two_pushes_within_a_step_acts() -> None:
    reader, writer = os.pipe()
    for robot, impulse_n_s in enumerate(([20.0, 0.0, 0.0], [0.0, 20.0, 0.0])):
        push = Push(robot=robot, impulse_n_s=impulse_n_s)
        os.write(writer, Command(push=push).model_dump_json().encode() + b"\n")
    frames: list[dict[str, Any]] = []

    def tell(kind: str, data: Any) -> None:
        frames.extend([data] if kind == "frame" else [])
        if len(frames) == 2:
            os.close(writer)

    with closing(Field(order([entrant("a"), entrant("b")], START, None, None))) as field, pytest.raises(EOFError):
        process.drive(field, process.Lines(reader), tell)
    os.close(reader)
    a, b = (np.array(robot["com_m"]) for robot in frames[1]["robots"])
    assert (a - b)[0] > 0.02
    assert (b - a)[1] > 0.02


def test_who_races_brings_its_robot_onto_the_ground_of_the_first() -> None:
    heavy = entrant("b")
    robot = RobotSettings(bar_mass_kg=9.0)
    changed = {"robot": robot, "terrain": TerrainSettings(size_m=50.0)}
    other = Entrant("b", 1, heavy.settings.model_copy(update=changed), heavy.policy)
    both = order([entrant("a"), other], START, 0.7, None)
    assert [one.settings.terrain.size_m for one in both.entrants] == [40.0, 40.0]
    assert both.entrants[1].settings.robot.bar_mass_kg == 9.0
    assert (both.start.terrain_difficulty, both.half_size_m, both.at(0.0).half_size_m) == (0.7, 20.0, None)

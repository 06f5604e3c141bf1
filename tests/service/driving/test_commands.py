"""Laws of commands: their ranges are those of the settings, and the last one has the last word."""

from __future__ import annotations

import pytest
from pydantic import BaseModel, ValidationError

from t6gps.service.driving.commands import Command, Push
from t6gps.workers.settings import RobotSettings, TerrainSettings


def bounds(model: type[BaseModel], name: str) -> tuple[float, float]:
    """Least and largest value of a field, which may also be null."""
    schema = model.model_json_schema()["properties"][name]
    (number,) = [one for one in schema.get("anyOf", [schema]) if one["type"] == "number"]
    return number["minimum"], number["maximum"]


def test_sliders_reach_as_far_as_the_settings() -> None:
    assert bounds(Command, "friction") == bounds(RobotSettings, "friction")
    assert bounds(Command, "terrain_difficulty") == bounds(TerrainSettings, "difficulty")


def test_of_two_commands_the_later_one_has_the_last_word_and_what_it_leaves_open_stays() -> None:
    first = Command(by="a", waypoint_m=[1.0, 2.0], friction=0.5, paused=True)
    second = Command(by="b", friction=0.7, paused=False, push=Push(robot=0, impulse_n_s=[1.0, 2.0, 3.0]))
    both = second.after(first)
    assert both == Command(
        by="b", waypoint_m=[1.0, 2.0], friction=0.7, paused=False, push=Push(robot=0, impulse_n_s=[1.0, 2.0, 3.0])
    )


def test_a_command_that_asks_nothing_says_what_may_be_asked() -> None:
    with pytest.raises(ValidationError, match="give one of waypoint_m, push, friction"):
        Command(by="a")

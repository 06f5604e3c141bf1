"""What may be asked of a drive. Ranges are those of the settings."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from t6gps.workers.settings import LARGEST_FRICTION, LEAST_FRICTION, STEEPEST_DIFFICULTY

ROBOTS_MOST_N = 4
"""In one race."""

FARTHEST_M = 1000.0
"""Of a waypoint from the middle, along x and along y; the ground may end before."""

PUSH_MOST_N_S = 200.0
"""Along each axis: a robot of 36 kg then moves by 5.6 m/s."""

Place = Annotated[float, Field(ge=-FARTHEST_M, le=FARTHEST_M)]
Impulse = Annotated[float, Field(ge=-PUSH_MOST_N_S, le=PUSH_MOST_N_S)]
Friction = Annotated[float, Field(ge=LEAST_FRICTION, le=LARGEST_FRICTION)]
Difficulty = Annotated[float, Field(ge=0.0, le=STEEPEST_DIFFICULTY)]


class Push(BaseModel):
    """An impulse [3] (N s) in the world on one of the robots, counted from 0."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    robot: int = Field(ge=0, lt=ROBOTS_MOST_N)
    impulse_n_s: list[Impulse] = Field(min_length=3, max_length=3)


class Command(BaseModel):
    """What changes in a drive; what is null stays as it is.

    by                   who says so, for others who look
    waypoint_m           where all robots head for, x and y (m)
    push                 an impulse on one robot
    friction             coefficient of friction between bars and ground
    terrain_difficulty   another ground, on which all begin again
    paused               whether time stands
    restart              all begin again on the same ground
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    by: Annotated[str, StringConstraints(max_length=40)] = ""
    waypoint_m: list[Place] | None = Field(None, min_length=2, max_length=2)
    push: Push | None = None
    friction: Friction | None = None
    terrain_difficulty: Difficulty | None = None
    paused: bool | None = None
    restart: bool | None = None

    @model_validator(mode="after")
    def _asks_something(self) -> Command:
        if not self.model_dump(exclude={"by"}, exclude_none=True):
            asked = ", ".join(name for name in type(self).model_fields if name != "by")
            raise ValueError(f"a command changes something; give one of {asked}")
        return self

    def after(self, other: Command) -> Command:
        """Both in one, where this one comes last and has the last word."""
        return Command(**{**dict(other), **{name: value for name, value in dict(self).items() if value is not None}})

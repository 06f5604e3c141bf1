"""What a simulator of the robot does, whichever library moves the bars: control steps of 0.1 s on one ground."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NoReturn, Self

from t6gps.storage.errors import PhysicsError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.robot.state import Array, RobotState
from t6gps.workers.settings import RobotSettings

CONTROL_STEP_S = 0.1
"""The policy commands ten times per second (paper Sec. IV-A)."""

GRAVITY_M_PER_S2 = 9.81
"""Standard gravity."""


class Unique:
    """Base of whatever leads to a simulator outside Python: it can be neither copied nor pickled.

    A copy would move the same simulator, and closing the copy would close the original's.
    """

    def __reduce__(self) -> NoReturn:
        """Refuse what `copy.copy`, `copy.deepcopy` and `pickle` ask for, by PhysicsError."""
        name = type(self).__name__
        raise PhysicsError(
            f"{name} cannot be copied or pickled: the copy would move the simulator of the original; make a second "
            f"{name} from the same settings"
        )


def reach_m(robot: RobotSettings) -> float:
    """The farthest that a winch changes its rest length in a control step (m)."""
    return robot.winch_speed_m_per_s * CONTROL_STEP_S


class Engine(Unique, ABC):
    """The robot with the settings `robot` on its ground. Several engines may live in one process.

    Leaving the context of an engine closes it.
    """

    robot: RobotSettings

    @abstractmethod
    def set_ground(self, terrain: Terrain | None) -> None:
        """Replace the ground, None being the plane z = 0, and put the robot into its neutral state."""

    @abstractmethod
    def reset(self, state: RobotState) -> None:
        """Put bars and rest lengths where `state` says, and forget all contacts of the past."""

    @abstractmethod
    def state(self) -> RobotState:
        """The present state."""

    @abstractmethod
    def control_step(self, command: Array) -> RobotState:
        """The state 0.1 s later, under commanded rest lengths [24] (m), clipped to the range of commands.

        Raises PhysicsError for a malformed command, and UnsoundStateError if the state leaves the range of sound ones
        (`limits.check_sound`). The engine then needs a reset.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the simulator; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

"""What the service asks of a learner, and the records that it gets. Light: whoever unpacks them loads no torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypedDict

import pyarrow as pa

from t6gps.learner.rows import AnyArray, Flags, Ints
from t6gps.storage.catalog import Run
from t6gps.storage.records import PolicySnapshot

Arrays = dict[str, AnyArray]
Progress = Iterator[tuple[int, int]]
"""(done, total) of a phase."""
Row = dict[str, float | None]
"""One row of a table, by column; flags and numbers of edges are among the numbers."""


class Manifest(TypedDict):
    """What a checkpoint says beside its arrays: version and output of the policy, numbers of layers and replays."""

    version: int
    offset_m: float
    scale_m: float
    layers: int
    replays: int


class LearnerState(NamedTuple):
    """What the next iteration depends on, between two iterations."""

    manifest: Manifest
    arrays: Arrays


def packed_policy(
    manifest: Manifest, arrays: Mapping[str, AnyArray], name: str = "layer", version: int | None = None
) -> PolicySnapshot:
    """The policy in a learner's state: the newest, or one whose layers have another name. KeyError without them."""
    layers = tuple(
        (arrays[f"{name}_{number}_weight"], arrays[f"{name}_{number}_bias"]) for number in range(manifest["layers"])
    )
    number = manifest["version"] if version is None else version
    return PolicySnapshot(number, layers, manifest["offset_m"], manifest["scale_m"])


class Report(NamedTuple):
    """Of the iteration just finished: the learner's columns of `iterations`, the rows of `classes` and of `models`."""

    iteration: Row
    classes: list[Row]
    models: pa.Table


@dataclass(frozen=True)
class Task:
    """What a learner knows of the robot and its task.

    target_speed_m_per_s   v* of the cost
    vertical_weight        weight of the vertical velocity in the cost
    command_range_m        improved actions are clipped to it
    offset_m, scale_m      u = offset + scale * network
    reach_m                farthest that a winch comes in a control step
    world_labels           canonical label of each world label of an action, by symmetry element [elements, nu]
    mirrored               the symmetry element mirrors the world [elements]
    """

    target_speed_m_per_s: float
    vertical_weight: float
    command_range_m: tuple[float, float]
    offset_m: float
    scale_m: float
    reach_m: float
    world_labels: Ints
    mirrored: Flags

    @property
    def cost_weights(self) -> tuple[float, float]:
        """v* (m/s) and the weight of the vertical velocity."""
        return self.target_speed_m_per_s, self.vertical_weight


class LearnerPort(Protocol):
    """What is asked of a learner between its phases, whatever process it is in."""

    def policy(self, version: int | None = None) -> PolicySnapshot:
        """The policy of a version, the newest by default."""

    def report(self) -> Report:
        """What the iteration just finished adds to the tables."""

    def state(self) -> LearnerState:
        """What a checkpoint holds of the learner."""

    def restore(self, manifest: Manifest, arrays: Mapping[str, AnyArray]) -> None:
        """Continue from `state()`."""

    def recall(self, run: Run) -> None:
        """Read from a run's tables what the next iteration depends on beside `state()`."""

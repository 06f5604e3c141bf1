"""What a policy's file says of itself: which policy it is, of which robot, and how its numbers are meant."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, JsonValue, ValidationError

from t6gps.service.config import Config
from t6gps.service.training.origin import Origin
from t6gps.storage.delta import policies
from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import SCHEMA_VERSION
from t6gps.workers.physics.engine import CONTROL_STEP_S
from t6gps.workers.robot.topology import BARS, CABLES

NUMBERS = {
    "nodes": "[12, 3] m, in the world, z up; nodes 2b and 2b + 1 end bar b",
    "com_velocity": "[3] m/s, of the centre of mass, in the world",
    "bar_angular_velocities": "[6, 3] rad/s, in the axes of the world",
    "rest_lengths": "[24] m, of the cables as the winches have them now",
    "waypoint": "[2] m, in the world",
    "state": "[2], support triangle and symmetry element of the decision before; -1, -1 before the first",
    "commands": "[24] m, commanded rest lengths of the cables",
    "next_state": "[2], the state that the next decision takes",
}
"""Inputs and outputs of a decision, by name."""


class Ground(BaseModel):
    """The file of the ground that the policy was trained on, which is not in the policy's file."""

    model_config = ConfigDict(frozen=True)

    name: str
    sha256: str


class Description(BaseModel):
    """A policy of a run, for those who have only its file.

    sha256           of the weights, as in the table `policies`
    layers           entries that it sees, widths of hidden layers, commands
    offset_m, scale_m  commands are offset + scale times the network's output
    bars, cables     pairs of nodes, in the order of inputs and outputs
    settings, steps  robot, ground and task of the run, and control steps of its episodes
    """

    model_config = ConfigDict(frozen=True)

    kind: Literal["t6gps policy"] = "t6gps policy"
    schema_version: int
    made_by: str
    run: str
    policy_version: int
    sha256: str
    layers: tuple[int, ...]
    offset_m: float
    scale_m: float
    control_period_s: float
    numbers: dict[str, str]
    bars: tuple[tuple[int, int], ...]
    cables: tuple[tuple[int, int], ...]
    settings: dict[str, JsonValue]
    steps: int
    ground: Ground | None

    def to_json(self) -> str:
        """As the files hold it."""
        return self.model_dump_json()


def describe(run: str, config: Config, origin: Origin | None, policy: PolicySnapshot) -> Description:
    """The description of a policy of a run."""
    settings = config.rollout.model_dump(mode="json", exclude_none=True)
    file = settings["terrain"].pop("file", None)
    kept = None if origin is None else origin.ground
    ground = None if file is None else Ground(name=Path(file).name, sha256="" if kept is None else kept.sha256)
    return Description(
        schema_version=SCHEMA_VERSION,
        made_by=f"t6gps {metadata.version('t6gps')}",
        run=run,
        policy_version=policy.version,
        sha256=digest(policy),
        layers=(policy.layers[0][0].shape[1], *(len(bias) for _, bias in policy.layers)),
        offset_m=policy.offset_m,
        scale_m=policy.scale_m,
        control_period_s=CONTROL_STEP_S,
        numbers=NUMBERS,
        bars=tuple((int(a), int(b)) for a, b in BARS),
        cables=tuple((int(a), int(b)) for a, b in CABLES),
        settings=settings,
        steps=config.run.steps,
        ground=ground,
    )


def read(text: str, where: Path) -> Description:
    """The description in a file. DataError where it is none, or one of a later version."""
    try:
        found = json.loads(text)
        version = found["schema_version"]
        if type(version) is int and version > SCHEMA_VERSION:
            raise DataError(
                f"{where} has a policy of schema version {version}, made by {found.get('made_by', 'unknown')}; this "
                f"version reads up to {SCHEMA_VERSION}; install that t6gps, or export the policy with this one"
            )
        return Description.model_validate(found)
    except (ValueError, TypeError, KeyError, ValidationError) as error:
        reason = " ".join(str(error).split())
        raise DataError(f"{where} does not say which policy it is: {reason}; export the policy again") from None


def digest(policy: PolicySnapshot) -> str:
    """SHA-256 of the weights, as in the table `policies`."""
    return str(policies.row(policy)["sha256"])

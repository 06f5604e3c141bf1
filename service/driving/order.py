"""What is to be driven: policies of runs, and where they begin."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from t6gps.service.training import evaluation_records, origin, policies
from t6gps.storage import spool, tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import policies as policy_rows
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.driving import Start
from t6gps.workers.settings import RolloutSettings


@dataclass(frozen=True)
class Entrant:
    """A policy, the run and the version that it is of, and the world in which it acts."""

    run: str
    version: int
    settings: RolloutSettings
    policy: PolicySnapshot


@dataclass(frozen=True)
class Order:
    """Entrants, who all begin at the same start; `friction` in place of their own, unless it is None."""

    entrants: tuple[Entrant, ...]
    start: Start
    friction: float | None

    @property
    def half_size_m(self) -> float | None:
        """How far the ground reaches from its middle (m), None for the plane without end."""
        ground = self.entrants[0].settings.terrain
        ends = self.start.terrain_difficulty > 0 or ground.tilt_deg > 0 or ground.file is not None
        return ground.size_m / 2 if ends else None

    def to_json(self) -> str:
        """The order on one line, for another process."""
        entrants = [
            {
                "run": one.run,
                "settings": one.settings.model_dump(mode="json"),
                "policy": {name: np.asarray(value).tolist() for name, value in policy_rows.row(one.policy).items()},
            }
            for one in self.entrants
        ]
        return json.dumps({"entrants": entrants, "start": asdict(self.start), "friction": self.friction})

    @classmethod
    def of_json(cls, text: str) -> Order:
        """The order that `to_json` has told. DataError for a policy that has not come whole."""
        plain = json.loads(text)
        entrants = [
            Entrant(one["run"], one["policy"]["version"], _settings(one["settings"]), policy_rows.policy(one["policy"]))
            for one in plain["entrants"]
        ]
        return cls(tuple(entrants), Start(**plain["start"]), plain["friction"])

    def at(self, terrain_difficulty: float) -> Order:
        """The same on another ground. ConfigError where the ground is that of a file."""
        if self.entrants[0].settings.terrain.file is not None:
            raise ConfigError(
                f"the ground of run {self.entrants[0].run} is that of a file, which no number makes steeper; leave it"
            )
        return replace(self, start=replace(self.start, terrain_difficulty=terrain_difficulty))


def _settings(plain: object) -> RolloutSettings:
    return RolloutSettings.model_validate_json(json.dumps(plain))


def entrant(run: Run, version: int | None, evaluation_id: int | None = None) -> Entrant:
    """A policy of a run by its version, the newest by default, in the world of the run or of one of its evaluations.

    RunError naming the versions that are kept, DataError naming the evaluations.
    """
    policy = policies.load(run, version)
    if evaluation_id is None:
        config = origin.configured(run)
    else:
        config = evaluation_records.world(run, tables.read(run, "evaluations"), evaluation_id)
    return Entrant(run.name, policy.version, config.rollout, policy)


def start(run: Run, number: int, evaluation_id: int | None, difficulty: float) -> Start:
    """Where an episode of a run began, also one that waits for its iteration. DataError where there is none."""
    waits = spool.waiting(run.spool, number) if evaluation_id is None else None
    found = tables.episode(run, number, evaluation_id) if waits is None else waits
    seed, terrain_seed, index = (found.summary[name][0].as_py() for name in ("seed", "terrain_seed", "index"))
    return Start(seed, terrain_seed, difficulty, index)


def order(entrants: Sequence[Entrant], began: Start, difficulty: float | None, friction: float | None) -> Order:
    """Let entrants begin on the ground and with the task of the first; each brings the robot of its run.

    difficulty   of the ground, None for that of the start. ConfigError where that is the ground of a file
    """
    world = entrants[0].settings
    shared = {"terrain": world.terrain, "task": world.task}
    alike = tuple(replace(one, settings=one.settings.model_copy(update=shared)) for one in entrants)
    wanted = Order(alike, began, friction)
    return wanted if difficulty in (None, began.terrain_difficulty) else wanted.at(difficulty)

"""A worker without a robot: episodes that follow the schemas in no time, and faults on order.

Orders are files in a folder: `episode-7` says what happens when episode 7 is run, `start` what happens when a worker
starts. A file holds the name of an order of ORDERS, and a number after it says how often (`raise 2`); without one it
holds for ever. So an order reaches whichever process comes to it, and outlives that process.
"""

from __future__ import annotations

import ctypes
import os
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import fields, schema
from t6gps.storage.errors import ConfigError, PhysicsError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.physics.bullet import pybullet

Known = dict[str, int | float | NDArray[np.int64]]
"""Columns that are not random, by name: one value for all rows, or a value for each."""

ENDLESS_STEPS_N = 2**31 - 1
"""The most that Bullet takes."""


class StubWorker:
    """Runs plans like `worker.RolloutWorker`: random numbers from the plan's seed, each episode taking `episode_s`."""

    def __init__(self, settings: object, episode_s: float = 0.0, orders: Path | None = None) -> None:
        self._episode_s, self._orders = episode_s, orders
        self._step = 0
        if self._order("start"):
            raise ConfigError("this worker was ordered to fail when it starts; take the order back")

    def run(self, plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
        """The episode, or the fault that was ordered for it."""
        self._step = 0
        order = self._order(f"episode-{plan.episode_id}")
        if self._episode_s or order == "slow":
            time.sleep(self._episode_s * (SLOW_FACTOR if order == "slow" else 1))
        self._step = plan.steps // 2
        return ORDERS.get(order, episode)(plan, snapshot)

    def position(self) -> tuple[int, list[dict[str, object]]]:
        """Control step, and no states: there is no robot."""
        return self._step, []

    def close(self) -> None:
        """Nothing to release."""

    def _order(self, name: str) -> str:
        if self._orders is None:
            return ""
        file = self._orders / name
        try:
            order, *times = file.read_text().split()
        except FileNotFoundError:
            return ""
        if times:
            if times == ["0"]:
                return ""
            draft = file.with_name(f".{name}.{os.getpid()}")
            draft.write_text(f"{order} {int(times[0]) - 1}")
            draft.replace(file)
        return order


SLOW_FACTOR = 10
"""An episode ordered to be slow takes this many times as long."""


def episode(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    """A sound episode of random numbers that depends on the plan and the policy's version alone."""
    rng = np.random.default_rng(plan.seed)
    known: Known = {
        "episode_id": plan.episode_id,
        "iteration": plan.iteration,
        "index": plan.index,
        "seed": plan.seed,
        "terrain_seed": plan.terrain_seed,
        "terrain_difficulty": plan.terrain_difficulty,
        "noise_std_m": plan.noise_std_m,
        "policy_version": snapshot.version,
        "steps": plan.steps,
    }
    rows = plan.steps + 1
    return Episode(
        _table(schema.FRAMES, rows, known | {"step": np.arange(rows)}, rng), _table(schema.EPISODES, 1, known, rng)
    )


def _raise(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    raise PhysicsError(f"episode {plan.episode_id} was ordered to fail")


def _hang_in_python(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    while True:
        pass


def _hang_in_c(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    """PyBullet steps a world without end and holds the interpreter's lock all the while."""
    client = pybullet.connect(pybullet.DIRECT)
    pybullet.setPhysicsEngineParameter(numSubSteps=ENDLESS_STEPS_N, physicsClientId=client)
    pybullet.stepSimulation(physicsClientId=client)
    return episode(plan, snapshot)


def _exit(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    print(f"episode {plan.episode_id} was ordered to exit", flush=True)
    os._exit(1)


def _fault(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    """The process faults in C."""
    ctypes.string_at(0)
    return episode(plan, snapshot)


def _with(name: str, change: Callable[[pa.Array], pa.Array]) -> Callable[[EpisodePlan, PolicySnapshot], Episode]:
    def broken(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
        whole = episode(plan, snapshot)
        i = whole.frames.column_names.index(name)
        column = change(whole.frames.column(name).combine_chunks())
        return Episode(whole.frames.set_column(i, pa.field(name, column.type), column), whole.summary)

    return broken


def _without_cost(plan: EpisodePlan, snapshot: PolicySnapshot) -> Episode:
    whole = episode(plan, snapshot)
    return Episode(whole.frames.drop_columns(["cost"]), whole.summary)


def _nan(column: pa.Array) -> pa.Array:
    return pa.array([np.nan] * len(column), column.type)


def _short(column: pa.Array) -> pa.Array:
    return pa.array([row[:-1] for row in column.to_pylist()], column.type)


ORDERS: dict[str, Callable[[EpisodePlan, PolicySnapshot], Episode]] = {
    "raise": _raise,
    "hang-in-python": _hang_in_python,
    "hang-in-c": _hang_in_c,
    "exit": _exit,
    "fault": _fault,
    "slow": episode,
    "nan": _with("cost", _nan),
    "wrong-type": _with("cost", lambda column: column.cast(pa.float32())),
    "wrong-shape": _with("nodes", _short),
    "wrong-columns": _without_cost,
}


def _table(definition: pa.Schema, rows: int, known: Known, rng: np.random.Generator) -> pa.Table:
    columns = []
    for field in definition:
        length = fields.vector_length(field)
        if field.name in known:
            column = pa.array(np.broadcast_to(known[field.name], rows), field.type)
        elif length is not None:
            flat = pa.array(rng.standard_normal(rows * length).astype(np.float32))
            column = pa.ListArray.from_arrays(pa.array(np.arange(rows + 1) * length, pa.int32()), flat, field.type)
        elif pa.types.is_string(field.type):
            column = pa.array(["completed"] * rows, field.type)
        else:
            column = pa.array(rng.integers(0, 3, rows), field.type)
        columns.append(column)
    return pa.Table.from_arrays(columns, schema=definition)

"""What there is to say of a run in a line, and of its iterations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import pyarrow.compute as pc

from t6gps.service.training import origin
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, StoreError, T6GpsError
from t6gps.storage.sql import cache

Row: TypeAlias = Mapping[str, int | float | None]


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """A run in a line.

    planned, done   iterations; None for a run that is damaged
    at_work         whether a process trains it; None where that cannot be known
    fault           what is damaged
    cost, forward_speed_m_per_s   of the last iteration (m2/s2, m/s)
    """

    name: str
    planned: int | None = None
    done: int | None = None
    cost: float | None = None
    forward_speed_m_per_s: float | None = None
    fault: str | None = None
    at_work: bool | None = None


def summary(run: Run) -> RunSummary:
    """A run in a line; what cannot be read of it is its fault, and hides no other run. StoreError as for all runs."""
    try:
        planned, found = origin.configured(run).run.iterations, cache.whole(run)
    except StoreError:
        raise
    except T6GpsError as error:
        return RunSummary(name=run.name, fault=str(error), at_work=_at_work(run))
    return RunSummary(
        name=run.name,
        planned=planned,
        done=found.done,
        cost=found.newest.get("cost"),
        forward_speed_m_per_s=found.newest.get("forward_speed_m_per_s"),
        at_work=_at_work(run),
    )


def _at_work(run: Run) -> bool | None:
    try:
        return catalog.process_of(run) is not None
    except RunError:  # its lock may not be read: a fact about the lock, not about its data
        return None


def iterations(run: Run, first: int = 0) -> list[Row]:
    """Rows of the table `iterations` from an iteration on, in order. DataError for a run that is damaged."""
    table = tables.read(run, "iterations", filter=pc.field("iteration") >= first)
    rows: list[Row] = table.sort_by("iteration").to_pylist()
    return rows

"""What there is to say of a run in a line, and of its iterations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeAlias

import pyarrow.compute as pc

from t6gps.service.training import origin
from t6gps.storage import tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import StoreError, T6GpsError

Row: TypeAlias = Mapping[str, int | float | None]


@dataclass(frozen=True, kw_only=True)
class RunSummary:
    """A run in a line.

    planned, done   iterations; None for a run that is damaged
    fault           what is damaged
    cost, forward_speed_m_per_s   of the last iteration (m2/s2, m/s)
    """

    name: str
    planned: int | None = None
    done: int | None = None
    cost: float | None = None
    forward_speed_m_per_s: float | None = None
    fault: str | None = None


def summary(run: Run) -> RunSummary:
    """A run in a line; what cannot be read of it is its fault, and hides no other run. StoreError as for all runs."""
    try:
        planned, done = origin.configured(run).run.iterations, tables.committed_iterations(run)
        tables.files(run)  # all are whole
        last = iterations(run, done - 1)[-1:]
    except StoreError:
        raise
    except T6GpsError as error:
        return RunSummary(name=run.name, fault=str(error))
    row: Row = last[0] if last else {}
    cost, speed = row.get("cost"), row.get("forward_speed_m_per_s")
    return RunSummary(name=run.name, planned=planned, done=done, cost=cost, forward_speed_m_per_s=speed)


def iterations(run: Run, first: int = 0) -> list[Row]:
    """Rows of the table `iterations` from an iteration on, in order. DataError for a run that is damaged."""
    table = tables.read(run, "iterations", filter=pc.field("iteration") >= first)
    rows: list[Row] = table.sort_by("iteration").to_pylist()
    return rows

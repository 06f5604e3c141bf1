"""How a rival did along its training, in a file of its run: RUN/curve.json."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass

from t6gps.service.training.evaluation import Evaluation
from t6gps.storage import durable
from t6gps.storage.catalog import Run

FILE = "curve.json"


@dataclass(frozen=True)
class Point:
    """What a rival had become after so many control steps.

    wall_s, cpu_s   of its training so far, evaluations apart: by the clock, and of the one thread that it takes
    """

    steps: int
    wall_s: float
    cpu_s: float
    evaluation: Evaluation


def keep(run: Run, points: Sequence[Point]) -> None:
    """Keep the points so far."""
    path = run.path / FILE
    rows = [asdict(point) for point in points]
    durable.hidden(path).write_text(json.dumps(rows, indent=2) + "\n")
    durable.publish(path)


def kept(run: Run) -> list[Point]:
    """The points that the run has; none where it is no rival's."""
    path = run.path / FILE
    if not path.exists():
        return []
    rows = json.loads(path.read_text(encoding="utf-8"))
    return [Point(**row | {"evaluation": Evaluation.from_json(json.dumps(row["evaluation"]))}) for row in rows]

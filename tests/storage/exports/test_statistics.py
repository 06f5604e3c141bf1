"""Laws of statistics that are counted episode by episode."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import fields
from t6gps.storage.exports import statistics
from t6gps.storage.exports.statistics import Totals

PARTS = (1, 7, 40)
"""Rows of the episodes."""


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_statistics_of_parts_are_those_of_the_whole(offset: float) -> None:
    rng, totals, parts = np.random.default_rng(3), Totals(), []
    for rows_n in PARTS:
        parts.append(rng.normal(offset, 2.0, (rows_n, 4)).astype(np.float32))
        statistics.add(totals, {"nodes": parts[-1]})
    whole, found = np.concatenate(parts).astype(np.float64), totals["nodes"].to_json()
    assert found["min"] == whole.min(axis=0).tolist()
    assert found["max"] == whole.max(axis=0).tolist()
    assert found["count"] == [sum(PARTS)]
    np.testing.assert_allclose(found["mean"], whole.mean(axis=0), rtol=1e-12)
    np.testing.assert_allclose(found["std"], whole.std(axis=0), rtol=1e-8)


def test_nulls_do_not_count() -> None:
    definition = pa.schema(
        [
            fields.scalar("edge", pa.int8(), "1", "", nullable=True),
            fields.scalar("slope", pa.float64(), "deg", "", nullable=True),
            fields.vector("action", 2, "m", "", nullable=True),
            fields.scalar("name", pa.string(), "", ""),
        ]
    )
    rows = [
        {"edge": 2, "slope": None, "action": [1.0, 2.0], "name": "a"},
        {"edge": None, "slope": None, "action": None, "name": "b"},
        {"edge": 4, "slope": None, "action": [3.0, -2.0], "name": "c"},
    ]
    totals = Totals()
    statistics.add(totals, statistics.arrays(pa.Table.from_pylist(rows, definition)))
    assert totals.keys() == {"edge", "slope", "action"}
    assert totals["edge"].to_json() == {"min": [2.0], "max": [4.0], "mean": [3.0], "std": [1.0], "count": [2]}
    assert totals["slope"].to_json() == {"min": [], "max": [], "mean": [], "std": [], "count": [0]}
    assert totals["action"].to_json() == {
        "min": [1.0, -2.0],
        "max": [3.0, 2.0],
        "mean": [2.0, 0.0],
        "std": [1.0, 2.0],
        "count": [2],
    }

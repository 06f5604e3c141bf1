"""Laws of the check that every table passes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import fields, schema
from t6gps.storage.errors import DataError

NODES = schema.FRAMES.get_field_index("nodes")


def _with(frames: pa.Table, name: str, values: list[Any]) -> pa.Table:
    field = schema.FRAMES.field(name)
    return frames.set_column(frames.schema.get_field_index(name), field, pa.array(values, field.type))


def _broken(frames: pa.Table, row: int) -> list[tuple[pa.Table, str]]:
    """The frames with one thing wrong in a row, and what it is."""
    nodes, cost = frames.column("nodes").to_pylist(), frames.column("cost").to_pylist()
    changed = lambda values, value: [*values[:row], value, *values[row + 1 :]]  # noqa: E731
    return [
        (_with(frames, "cost", changed(cost, np.nan)), "column cost holds numbers that are not finite"),
        (_with(frames, "cost", changed(cost, None)), "column cost must not be null, found 1 nulls"),
        (_with(frames, "nodes", changed(nodes, [np.inf, *nodes[row][1:]])), "nodes holds numbers that are not finite"),
        (_with(frames, "nodes", changed(nodes, [None, *nodes[row][1:]])), "nodes holds nulls inside its vectors"),
        (_with(frames, "nodes", changed(nodes, nodes[row][1:])), "every entry of column nodes must hold 36 numbers"),
    ]


@pytest.mark.parametrize("case", range(5))
def test_one_bad_entry_is_found_wherever_it_lies_and_only_in_what_is_looked_at(make_episode: Any, case: int) -> None:
    frames = make_episode(1, 0).frames
    for row in (0, frames.num_rows - 1):
        broken, reason = _broken(frames, row)[case]
        for table in (broken, pa.concat_tables([frames, broken]), pa.concat_tables([frames, broken]).slice(2)):
            with pytest.raises(DataError, match=reason):
                fields.check(table, schema.FRAMES, "frames")
        fields.check(broken.slice(1) if row == 0 else broken.slice(0, row), schema.FRAMES, "frames")


def test_columns_are_as_declared(make_episode: Any) -> None:
    frames = make_episode(1, 0).frames
    assert fields.check(frames, schema.FRAMES, "frames") is frames
    with pytest.raises(DataError, match="columns must be"):
        fields.check(frames.drop_columns("cost"), schema.FRAMES, "frames")
    single = frames.set_column(NODES, "nodes", frames.column("nodes").cast(pa.list_(pa.float64())))
    with pytest.raises(DataError, match=r"column nodes must be list<item: float>, found list<item: double>"):
        fields.check(single, schema.FRAMES, "frames")

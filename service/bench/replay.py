"""Recorded episodes under new numbers: as many as a measurement needs, without simulating each."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow as pa

from t6gps.storage.records import Episode


def numbered(episode: Episode, numbers: Mapping[str, int]) -> Episode:
    """The episode with constants in the place of those of its columns that `numbers` names."""
    return Episode(_with(episode.frames, numbers), _with(episode.summary, numbers))


def _with(table: pa.Table, numbers: Mapping[str, int]) -> pa.Table:
    for name in set(numbers).intersection(table.column_names):
        place = table.schema.get_field_index(name)
        field = table.schema.field(place)
        table = table.set_column(place, field, pa.array(np.full(table.num_rows, numbers[name]), field.type))
    return table

"""Laws of results and arrays: every form has the same values, in the shapes of the schema, read when asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import fields, schema
from t6gps.storage.store import arrays
from t6gps.storage.store.episode import StoredEpisode
from t6gps.storage.store.result import Result


def result(table: pa.Table, opened: list[int] | None = None) -> Result:
    @contextmanager
    def batches() -> Iterator[pa.RecordBatchReader]:
        (opened if opened is not None else []).append(1)
        yield pa.RecordBatchReader.from_batches(table.schema, table.to_batches(max_chunksize=2))

    return Result(batches)


def test_every_form_has_the_same_values(make_episode: Any) -> None:
    table = make_episode(1, 0).frames.select(["step", "cost", "entry_edge", "nodes", "action"])
    found = result(table)
    assert found.arrow().equals(table)
    assert pa.Table.from_batches(list(found)).equals(table)
    assert found.pandas()["cost"].tolist() == table["cost"].to_pylist()
    assert found.polars().to_arrow()["step"].to_pylist() == table["step"].to_pylist()
    numbers = found.numpy()
    assert list(numbers) == table.column_names
    np.testing.assert_array_equal(numbers["nodes"], np.array(table["nodes"].to_pylist(), np.float32).reshape(6, 12, 3))


def test_a_question_is_put_when_rows_are_asked_for_and_once() -> None:
    opened: list[int] = []
    found = result(pa.table({"a": [1, 2, 3]}), opened)
    assert not opened
    assert found.arrow() is found.arrow()
    found.numpy()
    assert len(opened) == 1
    assert [batch.num_rows for batch in found] == [2, 1]


def test_shapes_are_those_that_the_schema_tells() -> None:
    vectors = {f.name: f for t in schema.TABLES.values() for f in t if fields.vector_length(f) is not None}
    assert vectors.keys() == arrays.SHAPES.keys()
    for name, field in vectors.items():
        shape = arrays.SHAPES[name]
        assert np.prod(shape) == fields.vector_length(field)
        told = field.metadata[b"description"].decode()
        assert (str(list(shape)) in told) == (len(shape) == 2), name


@pytest.mark.parametrize(
    ("values", "kind", "expected"),
    [
        ([1, None], pa.int8(), np.array([1, np.nan])),
        ([True, None], pa.bool_(), np.array([1, np.nan])),
        ([1.5, None], pa.float32(), np.array([1.5, np.nan], np.float32)),
        ([[1, 2], None], pa.list_(pa.int32()), np.array([[1, 2], [np.nan, np.nan]])),
        ([[1, 2], [3, 4]], pa.list_(pa.int32()), np.array([[1, 2], [3, 4]], np.int32)),
        ([[1.0]], pa.list_(pa.float64()), np.array([[1.0]])),
        (["a", None], pa.string(), np.array(["a", None], object)),
        ([], pa.int32(), np.empty(0, np.int32)),
    ],
)
def test_what_is_missing_is_nan_and_never_zero(values: list[Any], kind: pa.DataType, expected: Any) -> None:
    found = arrays.array("x", pa.chunked_array([pa.array(values, kind)]))
    assert (found.dtype, found.shape) == (expected.dtype, expected.shape)
    np.testing.assert_array_equal(found, expected)


def test_lists_of_several_lengths_are_objects_and_no_rows_have_a_shape() -> None:
    ragged = arrays.array("layers", pa.chunked_array([pa.array([[1], [2, 3]], pa.list_(pa.int32()))]))
    assert ragged.tolist() == [[1], [2, 3]]
    none = pa.chunked_array([pa.array([], pa.list_(pa.float32()))])
    assert arrays.array("nodes", none).shape == (0, 12, 3)
    assert np.isnan(arrays.array("action", pa.chunked_array([pa.array([None], pa.list_(pa.float32()))]))).shape == (
        1,
        24,
    )


def test_an_episode_has_each_column_in_its_shape_and_no_action_after_the_last_state(make_episode: Any) -> None:
    made = make_episode(1, 0)
    episode = StoredEpisode(made.frames, made.summary.to_pylist()[0])
    assert list(episode) == schema.FRAMES.names
    assert (episode["nodes"].shape, episode["bar_orientations"].shape) == ((6, 12, 3), (6, 6, 4))
    assert episode.steps == 5 == len(episode["action"]) == len(episode["action_mean"])
    np.testing.assert_array_equal(episode["action"], schema.array(made.frames, "action"))
    with pytest.raises(KeyError, match="speed; columns: episode_id"):
        episode["speed"]

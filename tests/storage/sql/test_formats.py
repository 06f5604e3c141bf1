"""Laws of a result's forms: each of DuckDB's types has its value in each of them, and one batch at most is held."""

from __future__ import annotations

import csv
import io
import json
import math
from typing import Any

import duckdb
import pyarrow as pa
import pytest

from t6gps.storage.errors import QueryError
from t6gps.storage.sql import formats

INFINITE = (
    "[MAP {'NaN': [{'a': 'nan'::DOUBLE, 'b': '-Infinity \"NaN\" \\'}]}, MAP {'x': [{'a': 'inf'::DOUBLE, 'b': ''}]}]"
)
FINITE = [{"NaN": [{"a": None, "b": '-Infinity "NaN" \\'}]}, {"x": [{"a": None, "b": ""}]}]

VALUES: list[tuple[str, object, str]] = [
    # expression, value in JSON, cell in CSV
    ("sum(400)", 400, "400"),
    ("170141183460469231731687303715884105727::HUGEINT", 2**127 - 1, str(2**127 - 1)),
    ("340282366920938463463374607431768211455::UHUGEINT", 2**128 - 1, str(2**128 - 1)),
    ("9007199254740993", 2**53 + 1, str(2**53 + 1)),
    ("18446744073709551615::UBIGINT", 2**64 - 1, str(2**64 - 1)),
    ("255::UTINYINT", 255, "255"),
    ("65535::USMALLINT", 65535, "65535"),
    ("4294967295::UINTEGER", 4294967295, "4294967295"),
    ("(-128)::TINYINT", -128, "-128"),
    ("(-32768)::SMALLINT", -32768, "-32768"),
    ("(-5)::INTEGER", -5, "-5"),
    ("'12345678901234567890123'::BIGNUM", 12345678901234567890123, "12345678901234567890123"),
    ("1.50::DECIMAL(4, 2)", 1.5, "1.50"),
    ("0.1::DOUBLE", 0.1, "0.1"),
    ("'nan'::DOUBLE", None, "nan"),
    ("'-inf'::FLOAT", None, "-inf"),
    ("NULL", None, ""),
    ("NULL::DOUBLE[]", None, ""),
    ("true", True, "true"),
    ("'NaN, \"é\"' || chr(10)", 'NaN, "é"\n', 'NaN, "é"\n'),
    ("''", "", ""),
    ("'{\"a\": [1]}'::JSON", {"a": [1]}, '{"a": [1]}'),
    ("'00000000-0000-0000-0000-00000000000a'::UUID", *2 * ("00000000-0000-0000-0000-00000000000a",)),
    (r"'\xFFa'::BLOB", *2 * (r"\xFFa",)),
    ("'101'::BIT", *2 * ("101",)),
    ("'b'::ENUM('a', 'b')", *2 * ("b",)),
    ("DATE '2020-01-02'", *2 * ("2020-01-02",)),
    ("DATE 'infinity'", *2 * ("infinity",)),
    ("TIME '01:02:03.5'", *2 * ("01:02:03.5",)),
    ("'01:02:03+02'::TIMETZ", *2 * ("01:02:03+02",)),
    ("TIMESTAMP '2020-01-02 03:04:05.6'", *2 * ("2020-01-02 03:04:05.6",)),
    ("TIMESTAMP_NS '2020-01-02 03:04:05.123456789'", *2 * ("2020-01-02 03:04:05.123456789",)),
    ("TIME_NS '01:02:03.123456789'", *2 * ("01:02:03.123456789",)),
    ("'2020-01-02 03:04:05'::TIMESTAMP_S", *2 * ("2020-01-02 03:04:05",)),
    ("'2020-01-02 03:04:05.6'::TIMESTAMP_MS", *2 * ("2020-01-02 03:04:05.6",)),
    ("'2020-01-02 03:04:05.6+00'::TIMESTAMPTZ_NS", *2 * ("2020-01-02 03:04:05.6+00",)),
    ("'POINT (1 2)'::GEOMETRY", *2 * ("POINT (1 2)",)),
    ("TIMESTAMPTZ '2020-01-02 03:04:05+00'", *2 * ("2020-01-02 03:04:05+00",)),
    ("INTERVAL '1 month 2 days 3 seconds'", *2 * ("1 month 2 days 00:00:03",)),
    ("[0.5, NULL]", [0.5, None], "[0.5,null]"),
    ("[1, 2]::INT[2]", [1, 2], "[1,2]"),
    ("{'a': 1, 'b': [DATE '2020-01-02']}", {"a": 1, "b": ["2020-01-02"]}, '{"a":1,"b":["2020-01-02"]}'),
    ("row(1, 'x')", [1, "x"], '[1,"x"]'),
    ("MAP {1: 'x'}", {"1": "x"}, '{"1":"x"}'),
    ("union_value(number := 2)", {"number": 2}, '{"number":2}'),
    ("[1]::VARIANT", [1], "[1]"),
    (INFINITE, FINITE, json.dumps(FINITE, separators=(",", ":"))),
]


def written(sql: str, form: str) -> bytes:
    with duckdb.connect() as connection:
        connection.execute("SET TimeZone = 'UTC'")
        sink = io.BytesIO()
        formats.write(connection.sql(sql), form, sink)
        return sink.getvalue()


@pytest.mark.parametrize(("expression", "value", "cell"), VALUES)
def test_a_value_of_every_type_is_right_in_json_and_csv(expression: str, value: object, cell: str) -> None:
    sql = f"SELECT {expression} AS v, 1 AS one"
    assert json.loads(written(sql, "json"), parse_constant=pytest.fail) == [{"v": value, "one": 1}]
    assert list(csv.reader(io.StringIO(written(sql, "csv").decode(), newline=""))) == [["v", "one"], [cell, "1"]]


def test_every_type_of_duckdb_is_among_the_values() -> None:
    with duckdb.connect() as connection:
        known = {row[0] for row in connection.sql("SELECT logical_type FROM duckdb_types()").fetchall()}
        tried = {str(connection.sql(f"SELECT {value[0]}").types[0].id) for value in VALUES}
    assert {name.lower() for name in known} - tried == {"type"}  # it has no values of its own


def test_csv_tells_null_from_the_empty_text() -> None:
    assert written("SELECT NULL AS a, '' AS b", "csv") == b'"a","b"\n,""\n'


@pytest.mark.parametrize("rows_n", [0, 1, 2 * formats.BATCH_ROWS_N + 1])
def test_every_row_is_there_in_order_in_every_form(rows_n: int) -> None:
    sql = f"SELECT range AS n, [range] AS l FROM range({rows_n}) ORDER BY range DESC"
    rows = [{"n": n, "l": [n]} for n in reversed(range(rows_n))]
    assert json.loads(written(sql, "json")) == rows
    assert pa.ipc.open_stream(written(sql, "arrow")).read_all().to_pylist() == rows
    read = csv.DictReader(io.StringIO(written(sql, "csv").decode()))
    assert [{"n": int(row["n"]), "l": json.loads(row["l"])} for row in read] == rows


@pytest.mark.parametrize("form", ["json", "csv", "arrow"])
def test_no_more_than_a_batch_is_held(form: str) -> None:
    class Sink(io.BytesIO):
        largest_n, total_n = 0, 0

        def write(self, data: Any) -> int:
            size_n = len(memoryview(data).cast("B"))
            self.largest_n, self.total_n = max(self.largest_n, size_n), self.total_n + size_n
            return size_n

    with duckdb.connect() as connection:
        formats.write(connection.sql("SELECT repeat('x', 500) AS x FROM range(60000)"), form, sink := Sink())
    assert sink.total_n > 30e6
    assert sink.largest_n < 600 * formats.BATCH_ROWS_N


def test_a_column_that_is_asked_for_twice_has_two_names() -> None:
    sql = 'SELECT 1 AS a, 2 AS a, 3 AS A, 4 AS a_1, 5 AS "x.""y"'
    row = json.loads(written(sql, "json"))[0]
    assert list(row.values()) == [1, 2, 3, 4, 5]
    assert written(sql, "csv").decode().splitlines()[1] == "1,2,3,4,5"
    assert pa.ipc.open_stream(written(sql, "arrow")).read_all().to_pylist() == [row]
    assert json.loads(written(sql, "head"))["columns"] == list(row)


@pytest.mark.parametrize("value", ["1::UHUGEINT", "[{'a': 1::UHUGEINT}]", "'01:02:03+02'::TIMETZ"])
def test_what_arrow_cannot_hold_is_refused_in_arrow(value: str) -> None:
    with pytest.raises(QueryError, match="the type of column v; cast it"):
        written(f"SELECT {value} AS v", "arrow")


def head(sql: str) -> dict[str, Any]:
    return json.loads(written(sql, "head"))


def test_a_head_holds_the_first_rows_and_counts_all() -> None:
    few, many = (head(f"SELECT range AS n FROM range({rows_n})") for rows_n in (formats.HEAD_ROWS_N, 100_000))
    assert few["rows"] == many["rows"] == [[str(n)] for n in range(formats.HEAD_ROWS_N)]
    assert (few["rows_n"], many["rows_n"]) == (formats.HEAD_ROWS_N, 100_000)


@pytest.mark.parametrize(
    ("expression", "text", "shortened"),
    [
        ("[1, NULL, 3]", "[1, NULL, 3]", False),
        ("[0.123456, NULL, 3e-9, 4]::FLOAT[4]", "[0.1235, NULL, 3e-09, ... of 4]", True),
        ("range(36)", "[0, 1, 2, ... of 36]", True),
        ("repeat('x', 48)", "x" * 48, False),
        ("repeat('x', 49)", "x" * 45 + "...", True),
        ("{'a': 'nan'::DOUBLE}", "{'a': nan}", False),
        ("NULL::INT[]", None, False),
        ("''", "", False),
        ("0.1 + 0.2::DOUBLE", "0.30000000000000004", False),
    ],
)
def test_a_head_shortens_long_values_and_says_so(expression: str, text: str | None, shortened: bool) -> None:
    found = head(f"SELECT {expression} AS v")
    assert (found["rows"], found["shortened"]) == ([[text]], shortened)


def test_floats_come_back_bit_for_bit() -> None:
    sql = "SELECT exp(range)::DOUBLE AS d, exp(range / 8)::FLOAT AS f FROM range(-80, 80)"
    rows = pa.ipc.open_stream(written(sql, "arrow")).read_all().to_pylist()
    assert json.loads(written(sql, "json")) == rows
    read = csv.DictReader(io.StringIO(written(sql, "csv").decode()))
    assert all(
        float(row["d"]) == known["d"] and math.isclose(float(row["f"]), known["f"], rel_tol=1e-7)
        for row, known in zip(read, rows, strict=True)
    )

"""How an answer leaves the process of its query: as Arrow, Parquet, CSV or JSON, or its head as text for people.

DuckDB turns values into text, so each of its types has one. The rows pass in batches, and no more than one batch of
them is held. Of two columns with one name, the second gets a number: a, a_1.
"""

from __future__ import annotations

import json
import re
from typing import BinaryIO

import duckdb
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet
from duckdb.sqltypes import DuckDBPyType

from t6gps.storage.errors import QueryError

BATCH_ROWS_N, GROUP_ROWS_N = 8192, 32768
"""Rows of a batch, and of a row group of Parquet."""
HEAD_ROWS_N, HEAD_ITEMS_N, HEAD_CHARACTERS_N = 40, 3, 48
"""Rows of a head, items of its lists and characters of its texts."""

_INTEGERS = {"tinyint", "smallint", "integer", "bigint", "hugeint", "utinyint", "usmallint", "uinteger", "ubigint"}
_FLOATS = {"float", "double"}
_NUMBERS = _INTEGERS | _FLOATS | {"decimal", "boolean"}
_LISTS = {"list", "array"}
_NESTED = _LISTS | {"struct", "tuple", "map", "union", "variant"}
_NOT_IN_ARROW = re.compile(r"\b(UHUGEINT|TIME WITH TIME ZONE)\b")
"""Types that DuckDB gives to Arrow with other values."""
_STRING_OR_NOT_FINITE = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"|-?(?:NaN|Infinity)')


def write(relation: duckdb.DuckDBPyRelation, form: str, sink: BinaryIO) -> None:
    """Write the rows of `relation` in a form of FORMS. QueryError for a type that the form cannot hold."""
    FORMS[form](_distinct(relation), sink)


def rows(relation: duckdb.DuckDBPyRelation) -> pa.RecordBatchReader:
    """The rows of `relation` as batches of Arrow, as they come. QueryError for a type that Arrow cannot hold."""
    return _batches(_distinct(relation), BATCH_ROWS_N)


def _distinct(relation: duckdb.DuckDBPyRelation) -> duckdb.DuckDBPyRelation:
    return relation.project("*")  # which makes the names distinct


def _arrow(relation: duckdb.DuckDBPyRelation, sink: BinaryIO) -> None:
    """An Arrow IPC stream."""
    reader = _batches(relation, BATCH_ROWS_N)
    with pa.ipc.new_stream(sink, reader.schema) as stream:
        for batch in reader:
            stream.write_batch(batch)


def _parquet(relation: duckdb.DuckDBPyRelation, sink: BinaryIO) -> None:
    """A Parquet file, compressed with zstd, whose pages carry sums."""
    reader = _batches(relation, GROUP_ROWS_N)
    with pyarrow.parquet.ParquetWriter(sink, reader.schema, compression="zstd", write_page_checksum=True) as file:
        for batch in reader:
            file.write_batch(batch)


def _batches(relation: duckdb.DuckDBPyRelation, rows_n: int) -> pa.RecordBatchReader:
    for name, kind in zip(relation.columns, relation.types, strict=True):
        if found := _NOT_IN_ARROW.search(str(kind)):
            raise QueryError(f"Arrow has no {found[0]}, the type of column {name}; cast it, for example to VARCHAR")
    return relation.to_arrow_reader(rows_n)


def _csv(relation: duckdb.DuckDBPyRelation, sink: BinaryIO) -> None:
    """CSV with a line of names. What is nested is JSON, null is an empty cell, and the empty text is quoted."""
    columns = list(zip(map(_quoted, relation.columns), relation.types, strict=True))
    nested = [place for place, (_, kind) in enumerate(columns) if kind.id in _NESTED]
    cells = (f"{_csv_cell(column, kind)} AS {column}" for column, kind in columns)
    reader = relation.project(", ".join(cells)).to_arrow_reader(BATCH_ROWS_N)
    with pyarrow.csv.CSVWriter(sink, reader.schema) as file:
        for batch in reader:
            arrays = list(batch.columns)
            for place in nested:
                texts = [text and _finite(text) for text in arrays[place].to_pylist()]
                arrays[place] = pa.array(texts, pa.string())
            file.write(pa.record_batch(arrays, schema=reader.schema))


def _csv_cell(column: str, kind: DuckDBPyType) -> str:
    if kind.id in _NUMBERS:
        return column
    return f"CAST({f'to_json({column})' if kind.id in _NESTED else column} AS VARCHAR)"


def _json(relation: duckdb.DuckDBPyRelation, sink: BinaryIO) -> None:
    """A list with one object for each row, each on its line. Numbers that are not finite are null."""
    rows = relation.project("CAST(to_json(struct_pack(*COLUMNS(*))) AS VARCHAR)")
    before = "["
    for batch in rows.to_arrow_reader(BATCH_ROWS_N):
        sink.write((before + _finite(",\n".join(batch.column(0).to_pylist()))).encode())
        before = ",\n"
    sink.write(b"[]\n" if before == "[" else b"]\n")


def _finite(text: str) -> str:
    """JSON as DuckDB writes it, with null for NaN and Infinity, which JSON has only within strings."""
    if "NaN" not in text and "Infinity" not in text:
        return text
    return _STRING_OR_NOT_FINITE.sub(lambda found: found[0] if found[0].startswith('"') else "null", text)


def _head(relation: duckdb.DuckDBPyRelation, sink: BinaryIO) -> None:
    """The first rows as short texts, the number of all rows, and whether a value was shortened, as JSON."""
    columns = list(zip(map(_quoted, relation.columns), relation.types, strict=True))
    cells = (f"left({_head_cell(column, kind)}, {HEAD_CHARACTERS_N + 1})" for column, kind in columns)
    shortened = " OR ".join(f"len({column}) > {HEAD_ITEMS_N}" for column, kind in columns if kind.id in _LISTS)
    rows = relation.limit(HEAD_ROWS_N + 1).project(f"{', '.join(cells)}, {shortened or 'false'}").fetchall()
    rows_n = relation.aggregate("count(*)").fetchall()[0][0] if len(rows) > HEAD_ROWS_N else len(rows)
    shown = rows[:HEAD_ROWS_N]
    head = {
        "columns": relation.columns,
        "rows": [[text and _short(text) for text in row[:-1]] for row in shown],
        "rows_n": rows_n,
        "shortened": any(row[-1] or any(map(_is_long, filter(None, row[:-1]))) for row in shown),
    }
    sink.write(json.dumps(head).encode())


def _head_cell(column: str, kind: DuckDBPyType) -> str:
    if kind.id not in _LISTS:
        return f"CAST({column} AS VARCHAR)"
    kinds = dict(kind.children)
    item = "format('{:.4g}', item)" if str(kinds["child"]) in ("FLOAT", "DOUBLE") else "CAST(item AS VARCHAR)"
    items = f"list_transform({column}[1:{HEAD_ITEMS_N}], lambda item: coalesce({item}, 'NULL'))"
    return (
        f"CASE WHEN len({column}) <= {HEAD_ITEMS_N} THEN CAST({column} AS VARCHAR) "
        f"ELSE '[' || array_to_string({items}, ', ') || ', ... of ' || len({column}) || ']' END"
    )


def _is_long(text: str) -> bool:
    return len(text) > HEAD_CHARACTERS_N


def _short(text: str) -> str:
    return text[: HEAD_CHARACTERS_N - 3] + "..." if _is_long(text) else text


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


FORMS = {"arrow": _arrow, "parquet": _parquet, "csv": _csv, "json": _json, "head": _head}

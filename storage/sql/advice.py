"""What to do about a query that was refused or failed: its error's own sentence first, then what there is."""

from __future__ import annotations

import difflib
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain

import duckdb
import pyarrow as pa

from t6gps.storage.errors import QueryError
from t6gps.storage.sql import views

MESSAGE_LENGTH_N = 10_000

_ALLOWED = (
    "allowed is one SELECT (or WITH ... SELECT, DESCRIBE, SHOW TABLES) over the tables "
    f"{', '.join(views.asked())}; files, settings and extensions are out of reach"
)
_NO_TABLE = re.compile(r"Table with name (.+?) does not exist")
_NO_COLUMN = re.compile(
    r'(?:Referenced (?:column|table)|does not have a column named|Column(?= .* does not exist on)) "(.+?)"'
)


def refusal(found: Sequence[str]) -> str:
    """Why statements of the types `found` are refused."""
    if list(found) == ["MULTI"]:
        return (
            "this SQL is refused: it takes several statements, as a PIVOT does whose values are not named; "
            "name them: PIVOT episodes ON ended_by IN ('completed') USING count(*)"
        )
    return f"this SQL is refused: found {', '.join(found) or 'nothing'}\n{_ALLOWED}"


def parameters(wanted: Collection[str], given: Collection[str]) -> str:
    """Why SQL whose parameters are `wanted` is refused with values for those `given`."""
    lacks = [f"${name} has no value" for name in sorted(set(wanted) - set(given))]
    unused = [f"the value {name} is not used" for name in sorted(set(given) - set(wanted))]
    known = ", ".join(f"${name}" for name in sorted(wanted)) or "none"
    return f"{'; '.join(lacks + unused)}; parameters of this SQL: {known}; give each a value: --param NAME=VALUE"


def explained(error: Exception, sql: str, tables: Mapping[str, pa.Schema]) -> str:
    """The error's own sentence, and the remedy for its cause, where there are such tables."""
    message = str(error)[:MESSAGE_LENGTH_N]
    if isinstance(error, MemoryError) or message.startswith("Out of Memory"):
        message = message.split("\n", 1)[0]  # DuckDB's own advice is to change settings, which are locked
        return f"{message}\nselect fewer columns, filter by iteration, or aggregate before joining or sorting"
    if wrong := _NO_TABLE.search(message):  # DuckDB's own guess may be a table that is out of reach
        return f"{message[: wrong.end()]}\n{_nearest(wrong[1], tables)}{_ALLOWED}"
    if wrong := _NO_COLUMN.search(message):
        asked = [table for table in tables if re.search(rf"\b{table}\b(?!\s*\()", sql, re.IGNORECASE)]
        columns = {table: tables[table].names for table in asked}
        guess = "" if "Candidate" in message else _nearest(wrong[1], chain(*columns.values()))
        return f"{message}\n{guess}" + "\n".join(f"{table}: {', '.join(names)}" for table, names in columns.items())
    if isinstance(error, duckdb.BinderException | QueryError):  # they say themselves what to do
        return message
    return f"{message}\n{_ALLOWED}"


def _nearest(name: str, known: Iterable[str]) -> str:
    found = difflib.get_close_matches(name.lower(), list(known), n=1)
    return f"did you mean {found[0]}?\n" if found else ""

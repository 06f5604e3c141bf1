"""SQL over the tables of runs, safe for questions from strangers.

DuckDB runs in a process of the question's own (`sandbox`) that sees the tables and nothing else: no files, no network,
no settings; one SELECT, bounded in length, nesting, memory, time and result. `inprocess` answers what the program's own
user asks.
"""

from __future__ import annotations

import io
import json
import mmap
import shutil
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from typing import BinaryIO

import pyarrow as pa

from t6gps.storage import tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log
from t6gps.storage.errors import DataError, QueryError, StoreError, T6GpsError
from t6gps.storage.objects import place, store
from t6gps.storage.sql import cache, sandbox, views, warm
from t6gps.storage.sql.engine import RunFiles

SQL_BYTES_N = 64 * 1024
BRACKET_DEPTH_N = 100
_WORDS_BYTES_N = 2**16


@dataclass(frozen=True)
class Head:
    """The first rows of a result, as short texts for people.

    columns     names, each once
    rows        texts, null where there is no value; at most formats.HEAD_ROWS_N
    rows_n      rows of the whole result
    shortened   whether a value is longer than its text
    """

    columns: list[str]
    rows: list[list[str | None]]
    rows_n: int
    shortened: bool


@dataclass(frozen=True)
class About:
    """What the table `runs` says: its columns, those of views.RUNS among them, and the row of a run."""

    columns: pa.Schema
    row: Callable[[Run], Mapping[str, object]]


@dataclass(frozen=True)
class Question:
    """One SELECT over the tables of runs, and over the views on them (views.asked).

    parameters   values of its $names: numbers, texts, flags, or lists of them
    about        what is said of runs; their names alone by default
    left_out     is told of each run that is damaged, which the answer then is without; by default it is an error
    """

    runs: Sequence[Run]
    sql: str
    parameters: Mapping[str, object] = field(default_factory=dict)
    about: About = About(views.RUNS, lambda run: {"run": run.name})
    left_out: Callable[[str], object] | None = None
    timeout_s: float = 30.0


def query(question: Question) -> pa.Table:
    """The result of a question; each table has the column `run` first.

    Only committed iterations are seen. Of two columns with one name, the second gets a number: cost, cost_1. Raises
    DataError where a table that the SQL names is not whole. QueryError, with DuckDB's own sentence first where there is
    one, for SQL that is refused or wrong, and beyond 64 kB of SQL, 100 nested brackets, 2 GiB of memory, a result of
    1 GB or the question's seconds.
    """
    with answer(question, "arrow") as result:
        return pa.ipc.open_stream(mmap.mmap(result.fileno(), 0, access=mmap.ACCESS_READ)).read_all()


def write(question: Question, form: str, sink: BinaryIO) -> None:
    """Write what `query` would return in a form of formats.FORMS, once the whole result is there.

    Its size is that of a file, not of memory. Raises errors as `query` does; nothing is written then.
    """
    with answer(question, form) as result:
        shutil.copyfileobj(result, sink)
    sink.flush()


def head(question: Question) -> Head:
    """The first rows of what `query` would return. Raises errors as `query` does; the result has no bound."""
    with answer(question, "head") as result:
        return Head(**json.load(result))


def answer(question: Question, form: str) -> BinaryIO:
    """A file with what `write` would write, at its start. Whoever asked closes it. Raises errors as `query` does."""
    try:
        return _answered(question, form)
    except DataError:
        if not cache.forget_torn(question.runs):
            raise
        return _answered(question, form)  # as if there had been none


def _answered(question: Question, form: str) -> BinaryIO:
    check_size(question.sql)
    files, about = read(question)
    with ExitStack() as stack, tempfile.TemporaryFile() as asked, tempfile.TemporaryFile() as words:
        result = stack.enter_context(tempfile.TemporaryFile())
        asked.write(_line(question, form, files) + _stream(about))
        asked.seek(0)
        status = warm.running().answered(asked, result, words, question.timeout_s)
        if status is None:
            raise QueryError(
                f"the query was stopped after {question.timeout_s:g} s; ask for fewer rows or columns, filter by "
                "iteration, or read the Parquet files directly"
            )
        if status:
            words.seek(0)
            message = words.read(_WORDS_BYTES_N).decode(errors="replace").strip()
            if status == sandbox.DAMAGED:
                raise damaged(question.runs, *json.loads(message))
            raise QueryError(_reason(status, message))
        result.seek(0)
        stack.pop_all()  # it stays open
        return result


def read(question: Question) -> tuple[dict[str, RunFiles], pa.Table]:
    """Of each table that the question may read the files, by run; and the table `runs`."""
    named, rows = views.read_by(question.sql), []
    of_files = named - {"runs"}
    files = {table: RunFiles() for table in of_files}
    checked = of_files | {"frames"} if of_files else set()  # committed first, it shows what `episodes` has lost
    found_by = cache.files if len(question.runs) > 1 else tables.files
    for run in question.runs:
        try:
            found = found_by(run, checked) if checked else {}
            row = question.about.row(run) if "runs" in named else None
        except T6GpsError as error:
            if question.left_out is None or isinstance(error, StoreError):
                raise
            question.left_out(str(error))
            continue
        for table in of_files:
            files[table][run.name] = found[table]
        if row is not None:
            rows.append(row)
    columns = question.about.columns
    return files, pa.Table.from_pylist(rows, columns) if rows else columns.empty_table()


def _line(question: Question, form: str, files: Mapping[str, RunFiles]) -> bytes:
    sent = {
        "sql": question.sql,
        "parameters": dict(question.parameters),
        "form": form,
        "files": {table: {run: asdict(found) for run, found in of_runs.items()} for table, of_runs in files.items()},
        "timeout_s": question.timeout_s,
        "environment": store.variables() if any(place.is_object(run.path) for run in question.runs) else {},
    }
    return json.dumps(sent).encode() + b"\n"


def _stream(table: pa.Table) -> bytes:
    sink = io.BytesIO()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return sink.getvalue()


def damaged(runs: Sequence[Run], table: str, name: str, why: str) -> DataError | StoreError:
    """The error for a table of a run that cannot be read to its end."""
    run = next(run for run in runs if run.name == name)
    try:
        with log.readable(run, table):
            raise OSError(why)
    except (DataError, StoreError) as error:
        return error


def check_size(sql: str) -> None:
    """Raise QueryError for SQL that is too long, nests too deep, or is no Unicode."""
    try:
        size_n = len(sql.encode())
    except UnicodeEncodeError as error:
        raise QueryError(f"the SQL is not valid Unicode: {error}; remove that character") from error
    depth = deepest = 0
    for character in sql:
        depth += (character in "([{") - (character in ")]}")
        deepest = max(deepest, depth)
    if size_n > SQL_BYTES_N:
        raise QueryError(f"the SQL has {size_n} bytes; at most {SQL_BYTES_N} are allowed; split the question")
    if deepest > BRACKET_DEPTH_N:
        raise QueryError(f"the SQL nests {deepest} brackets; at most {BRACKET_DEPTH_N} are allowed; use WITH")


def _reason(status: int, message: str) -> str:
    if status == sandbox.REFUSED:
        return message
    if status == sandbox.TOO_LARGE:
        return (
            f"the result is larger than {sandbox.RESULT_BYTES_N / 1e9:g} GB; select fewer columns, add a "
            "LIMIT, or read the Parquet files directly"
        )
    return (
        f"the query's process ended with {status}, most likely for want of memory or stack "
        f"({sandbox.MEMORY_BYTES_N / 1024**3:g} GiB allowed); simplify it, or filter earlier; "
        f"its last words: {message.splitlines()[-1] if message else 'none'}"
    )

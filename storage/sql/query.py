"""SQL over the tables of a run, safe for questions from strangers.

DuckDB runs in a child process (`sandbox`) that sees the tables and nothing else: no files, no network,
no settings; one SELECT, bounded in length, nesting, memory, time and result.
"""

from __future__ import annotations

import json
import mmap
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import BinaryIO

import pyarrow as pa

from t6gps.storage import tables
from t6gps.storage.catalog import Run
from t6gps.storage.delta import log
from t6gps.storage.errors import QueryError
from t6gps.storage.sql import sandbox

SQL_BYTES_N = 64 * 1024
BRACKET_DEPTH_N = 100
_ENVIRONMENT = {
    # Allocators that reserve address space per thread would eat the child's bound before the query starts.
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "MALLOC_ARENA_MAX": "2",
    "OMP_NUM_THREADS": "1",
    "PYTHONIOENCODING": "utf-8",  # of its refusal, whatever the locale
}


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


def query(run: Run, sql: str, *, timeout_s: float = 30.0) -> pa.Table:
    """The result of one SELECT over the tables of `run`.

    Only committed iterations are seen. Of two columns with one name, the second gets a number: cost, cost_1. Raises
    DataError for a run that is not whole. QueryError, with DuckDB's own sentence first where there is one, for SQL that
    is refused or wrong, and beyond 64 kB of SQL, 100 nested brackets, 2 GiB of memory, a result of 1 GB or `timeout_s`
    seconds.
    """
    with _answer(run, sql, "arrow", timeout_s) as result:
        return pa.ipc.open_stream(mmap.mmap(result.fileno(), 0, access=mmap.ACCESS_READ)).read_all()


def write(run: Run, sql: str, form: str, sink: BinaryIO, *, timeout_s: float = 30.0) -> None:
    """Write what `query` would return as arrow (an IPC stream), csv or json, once the whole result is there.

    Its size is that of a file, not of memory. Raises QueryError as `query` does; nothing is written then.
    """
    with _answer(run, sql, form, timeout_s) as result:
        shutil.copyfileobj(result, sink)
    sink.flush()


def head(run: Run, sql: str, *, timeout_s: float = 30.0) -> Head:
    """The first rows of what `query` would return. Raises QueryError as `query` does; the result has no bound."""
    with _answer(run, sql, "head", timeout_s) as result:
        return Head(**json.load(result))


@contextmanager
def _answer(run: Run, sql: str, form: str, timeout_s: float) -> Iterator[BinaryIO]:
    """The file with the answer that a process of its own has given, in a form of formats.FORMS."""
    _check_size(sql)
    files = {table: asdict(found) for table, found in tables.files(run).items()}
    question = {"sql": sql, "form": form, "files": files, "timeout_s": timeout_s}
    with tempfile.TemporaryFile() as result:
        try:
            child = subprocess.run(
                [sys.executable, "-P", "-m", sandbox.__name__],
                input=json.dumps(question).encode(),
                stdout=result,
                stderr=subprocess.PIPE,
                env={**os.environ, **_ENVIRONMENT},
                timeout=timeout_s,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise QueryError(
                f"the query was stopped after {timeout_s:g} s; ask for fewer rows or columns, filter by "
                "iteration, or read the Parquet files directly"
            ) from error
        if child.returncode:
            message = child.stderr.decode(errors="replace").strip()
            if child.returncode == sandbox.DAMAGED:
                raise log.damaged(run, *json.loads(message))
            raise QueryError(_reason(child.returncode, message))
        result.seek(0)
        yield result


def _check_size(sql: str) -> None:
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

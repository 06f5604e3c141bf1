"""What the process of a query does: one SELECT over the tables of runs, with everything else locked away.

It takes a question from its standard input, a line of JSON and then the table of runs as an Arrow IPC stream. It writes
the result to its standard output in the form that is asked for (`formats`), and says on its standard error why it
refused. `nursery` forks it.
"""

from __future__ import annotations

import errno
import json
import math
import os
import re
import resource
import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa

from t6gps.storage.delta import parquet
from t6gps.storage.delta.parquet import Files
from t6gps.storage.sql import advice, engine, formats, views
from t6gps.storage.sql.engine import RunFiles

RESULT_BYTES_N = 10**9
MEMORY_BYTES_N = 2 * 1024**3
REFUSED, TOO_LARGE, DAMAGED = 2, 3, 4

_FAULT = re.compile(r"Invalid Input Error: reading the stream registered as '(\w+)' failed: (.*)")
"""What DuckDB says of a table that pyarrow cannot read: its name, and why."""
_REASON_LENGTH_N = 300
_THREADS_N = 2
_SETTINGS: Mapping[str, int | str] = {"threads": _THREADS_N, "memory_limit": "1GB"}
_GRACE_S = 5
"""Whoever asked ends the process when its seconds are over, and is given so much time for that."""


def limit(timeout_s: float) -> None:
    """Set bounds that hold even when the parent dies, or when DuckDB's own limits do not reach."""
    pages_n = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    memory = pages_n * resource.getpagesize() + MEMORY_BYTES_N
    processor_s = math.ceil(timeout_s * _THREADS_N) + 1
    for kind, bound in (
        (resource.RLIMIT_AS, memory),
        (resource.RLIMIT_CPU, processor_s),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, RESULT_BYTES_N),  # the result is the only file that is written
    ):
        least = min(most for most in (bound, *resource.getrlimit(kind)) if most != resource.RLIM_INFINITY)
        resource.setrlimit(kind, (least, least))
    signal.setitimer(signal.ITIMER_REAL, timeout_s + _GRACE_S)  # which ends it, in whatever library it is


def fault(error: Exception, files: Mapping[str, RunFiles]) -> tuple[str, str, str] | None:
    """The table and the run that cannot be read to their end, and why, where a query says that it met such a table.

    None where they can be read after all: SQL may raise any text as an error, and memory or a network may be short.
    """
    said = _FAULT.match(str(error))
    if said is None:
        return None
    for run, of_run in files.get(said[1], {}).items():
        try:
            for _ in parquet.rows(said[1], of_run).to_batches():
                pass
        except MemoryError:
            return None
        except (pa.ArrowException, OSError) as reason:
            return said[1], run, str(reason)[:_REASON_LENGTH_N]
    return None


def answer() -> int:
    """Answer the question on the standard input; the exit status is 0, REFUSED, TOO_LARGE or DAMAGED."""
    pa.set_cpu_count(_THREADS_N)
    pa.set_io_thread_count(_THREADS_N)
    question, runs = _asked()
    os.environ.update(question["environment"])
    files = {
        table: {run: Files(**found) for run, found in of_runs.items()} for table, of_runs in question["files"].items()
    }
    try:
        with open(1, "wb", closefd=False) as result:  # its last bytes may not fit either
            formats.write(_relation(question, files, runs), question["form"], result)
    except engine.ERRORS as error:
        if isinstance(error, OSError) and error.errno == errno.EFBIG:
            return TOO_LARGE
        damage = fault(error, files)
        words = json.dumps(damage) if damage else advice.explained(error, question["sql"], views.asked(runs.schema))
        with open(2, "w", encoding="utf-8", errors="backslashreplace") as told:
            told.write(words)
        return DAMAGED if damage else REFUSED
    return 0


def _relation(question: Mapping[str, Any], files: Mapping[str, RunFiles], runs: pa.Table) -> duckdb.DuckDBPyRelation:
    connection = engine.Engine(_SETTINGS)
    connection.show(files, runs)
    limit(question["timeout_s"])
    return connection.ask(question["sql"], question["parameters"])


def _asked() -> tuple[dict[str, Any], pa.Table]:
    """The question, and the table of runs."""
    with open(0, "rb", closefd=False) as source:
        question = json.loads(source.readline())
        with pa.ipc.open_stream(source.read()) as stream:
            return question, stream.read_all()

"""The child process of `query`: one SELECT over the tables of runs, with everything else locked away.

It takes a question from its standard input, a line of JSON and then the table of runs as an Arrow IPC stream. It writes
the result to its standard output in the form that is asked for (`formats`), and says on its standard error why it
refused. Only DuckDB and pyarrow are loaded, and pandas
where somebody installed it, since pyarrow.dataset then imports it: it starts in a fraction of a second.
"""

from __future__ import annotations

import errno
import json
import math
import re
import resource
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import duckdb
import pyarrow as pa

from t6gps.storage.delta import parquet
from t6gps.storage.errors import QueryError
from t6gps.storage.sql import advice, formats, views

RESULT_BYTES_N = 10**9
MEMORY_BYTES_N = 2 * 1024**3
REFUSED, TOO_LARGE, DAMAGED = 2, 3, 4

_FAULT = re.compile(r"Invalid Input Error: reading the stream registered as '(\w+)' failed: (.*)")
"""What DuckDB says of a table that pyarrow cannot read: its name, and why."""
_THREADS_N = 2
_SETTINGS = (
    f"SET threads = {_THREADS_N}",
    "SET memory_limit = '1GB'",
    "SET temp_directory = ''",
    "SET enable_external_access = false",  # also extensions, and the variables of this program
    "SET lock_configuration = true",
)


def _limit(timeout_s: float) -> None:
    """Bounds that hold even when the parent dies, or when DuckDB's own limits do not reach."""
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


def _relation(question: Mapping[str, Any], runs: pa.Table) -> duckdb.DuckDBPyRelation:
    connection = duckdb.connect(":memory:")
    for table, files in question["files"].items():
        of_runs = {run: parquet.Files(**found) for run, found in files.items()}
        connection.register(table, parquet.rows_of_runs(table, of_runs))
    connection.register("runs", runs)
    connection.register("columns", views.described(views.asked(runs.schema)))
    for name, view in views.VIEWS.items():
        connection.execute(f"CREATE TEMP VIEW {name} AS {view.sql}")
    for setting in _SETTINGS:
        connection.execute(setting)
    _limit(question["timeout_s"])
    statements = connection.extract_statements(question["sql"])
    if [statement.type for statement in statements] != [duckdb.StatementType.SELECT]:
        raise QueryError(advice.refusal([statement.type.name for statement in statements]))
    wanted, given = statements[0].named_parameters, question["parameters"]
    if wanted != given.keys():
        raise QueryError(advice.parameters(wanted, given.keys()))
    return connection.sql(question["sql"], params=given) if given else connection.sql(question["sql"])


def _asked(source: BinaryIO) -> tuple[dict[str, Any], pa.Table]:
    """The question, and the table of runs."""
    question = json.loads(source.readline())
    with pa.ipc.open_stream(source.read()) as stream:
        return question, stream.read_all()


def main() -> int:
    """Answer the question on the standard input; the exit status is 0, REFUSED, TOO_LARGE or DAMAGED."""
    pa.set_cpu_count(_THREADS_N)
    pa.set_io_thread_count(_THREADS_N)
    question, runs = _asked(sys.stdin.buffer)
    try:
        with open(sys.stdout.fileno(), "wb", closefd=False) as result:  # its last bytes may not fit either
            formats.write(_relation(question, runs), question["form"], result)
    except (duckdb.Error, pa.ArrowException, OSError, MemoryError, QueryError) as error:
        if isinstance(error, OSError) and error.errno == errno.EFBIG:
            return TOO_LARGE
        if fault := _FAULT.match(str(error)):
            print(json.dumps(fault.groups()), file=sys.stderr)
            return DAMAGED
        print(advice.explained(error, question["sql"], views.asked(runs.schema)), file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())

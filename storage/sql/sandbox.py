"""The child process of `query`: one SELECT over the tables of a run, with everything else locked away.

It takes a question as JSON from its standard input, streams the result as Arrow IPC to its standard output,
and says on its standard error why it refused. Only DuckDB and pyarrow are loaded, and pandas where somebody installed
it, since pyarrow.dataset then imports it: it starts in a fraction of a second.
"""

from __future__ import annotations

import json
import math
import resource
import sys
from pathlib import Path
from typing import Any

import duckdb
import pyarrow as pa

from t6gps.storage import parquet, schema
from t6gps.storage.errors import QueryError

RESULT_BYTES_N = 10**9
MEMORY_BYTES_N = 2 * 1024**3
MESSAGE_LENGTH_N = 10_000
REFUSED, TOO_LARGE = 2, 3

_THREADS_N = 2
_SETTINGS = (
    f"SET threads = {_THREADS_N}",
    "SET memory_limit = '1GB'",
    "SET temp_directory = ''",
    "SET enable_external_access = false",  # also extensions, and the variables of this program
    "SET lock_configuration = true",
)
_ALLOWED = (
    "allowed is one SELECT (or WITH ... SELECT, DESCRIBE, SHOW TABLES) over the tables "
    f"{', '.join(schema.TABLES)}; files, settings and extensions are out of reach"
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
    ):
        resource.setrlimit(kind, (bound, bound))


def _answer(question: dict[str, Any]) -> pa.RecordBatchReader:
    connection = duckdb.connect(":memory:")
    for table, files in question["files"].items():
        connection.register(table, parquet.rows(table, files, question["iterations_n"]))
    for setting in _SETTINGS:
        connection.execute(setting)
    _limit(question["timeout_s"])
    statements = connection.extract_statements(question["sql"])
    if [statement.type for statement in statements] != [duckdb.StatementType.SELECT]:
        found = ", ".join(statement.type.name for statement in statements) or "nothing"
        raise QueryError(f"this SQL is refused: found {found}")
    return connection.sql(question["sql"]).to_arrow_reader()


def _explained(error: Exception) -> str:
    """The error's own sentence first, then what there is or what to do."""
    message = str(error)[:MESSAGE_LENGTH_N]
    if isinstance(error, MemoryError) or message.startswith("Out of Memory"):
        message = message.split("\n", 1)[0]  # DuckDB's own advice is to change settings, which are locked
        remedy = "select fewer columns, filter by iteration, or aggregate before joining or sorting"
    elif isinstance(error, duckdb.CatalogException | duckdb.BinderException):
        remedy = "\n".join(f"{table}: {', '.join(columns.names)}" for table, columns in schema.TABLES.items())
    else:
        remedy = _ALLOWED
    return f"{message}\n{remedy}"


def main() -> int:
    """Answer the question on the standard input; the exit status is 0, REFUSED or TOO_LARGE."""
    pa.set_cpu_count(_THREADS_N)
    pa.set_io_thread_count(_THREADS_N)
    written_n = 0
    try:
        reader = _answer(json.load(sys.stdin))
        with pa.ipc.new_stream(sys.stdout.buffer, reader.schema) as stream:
            for batch in reader:
                written_n += batch.nbytes
                if written_n > RESULT_BYTES_N:
                    return TOO_LARGE
                stream.write_batch(batch)
        sys.stdout.flush()
    except (duckdb.Error, pa.ArrowException, OSError, MemoryError, QueryError) as error:
        print(_explained(error), file=sys.stderr)
        return REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""DuckDB over the tables of runs: it sees them, the views on them, and nothing else of the machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TypeAlias, final

import duckdb
import pyarrow as pa
from pyarrow import fs

from t6gps.storage import schema
from t6gps.storage.delta import parquet
from t6gps.storage.delta.parquet import Files
from t6gps.storage.errors import QueryError
from t6gps.storage.objects import place
from t6gps.storage.sql import advice, views

RunFiles: TypeAlias = dict[str, Files]
"""The files of a table by the names of runs."""
ERRORS = (duckdb.Error, pa.ArrowException, OSError, MemoryError, QueryError)
"""What a query ends with: `advice.explained` says what to do."""
_LOCKED = (
    "SET temp_directory = ''",
    "SET enable_external_access = false",  # also extensions, and the variables of this program
    "SET lock_configuration = true",
)


def _stamps(of_runs: RunFiles) -> object:
    """What differs where a file was replaced under its name; always, in an object store."""
    paths = [path for of_run in of_runs.values() for path in of_run.paths]
    file_system, found = place.located(paths)
    if not isinstance(file_system, fs.LocalFileSystem):
        return object()
    return [(status.size, status.mtime_ns) for status in file_system.get_file_info(found)]


@final
class Engine:
    """A connection, with the tables that were shown to it last. It answers one question at a time.

    settings   of DuckDB, beside those that lock everything else away
    """

    def __init__(self, settings: Mapping[str, int | str]) -> None:
        self._connection = duckdb.connect(":memory:", config=dict(settings))
        self._shown: dict[str, tuple[RunFiles, object]] = {}
        self._runs: pa.Table | None = None

    def show(self, files: Mapping[str, RunFiles], runs: pa.Table) -> None:
        """Let it see the files of tables, by run, and the table `runs`. Tables that are not named stay as they are."""
        first = not self._shown
        for table in schema.TABLES:
            if table in files or first:
                of_runs = files.get(table, {})
                shown = of_runs, _stamps(of_runs)
                if self._shown.get(table) != shown:
                    self._connection.register(table, parquet.rows_of_runs(table, of_runs))
                    self._shown[table] = shown
        if first or not runs.equals(self._runs):
            self._connection.register("runs", runs)
            self._runs = runs
        if first:
            self._connection.register("columns", views.described(views.asked(runs.schema)))
            for name, view in views.VIEWS.items():
                self._connection.execute(f"CREATE TEMP VIEW {name} AS {view.sql}")
            for setting in _LOCKED:
                self._connection.execute(setting)

    def ask(self, sql: str, parameters: Mapping[str, object]) -> duckdb.DuckDBPyRelation:
        """The rows of one SELECT, lazily. QueryError for anything else, and for other parameters than it has."""
        statements = self._connection.extract_statements(sql)
        if [statement.type for statement in statements] != [duckdb.StatementType.SELECT]:
            raise QueryError(advice.refusal([statement.type.name for statement in statements]))
        wanted = statements[0].named_parameters
        if wanted != parameters.keys():
            raise QueryError(advice.parameters(wanted, parameters.keys()))
        return self._connection.sql(sql, params=dict(parameters)) if parameters else self._connection.sql(sql)

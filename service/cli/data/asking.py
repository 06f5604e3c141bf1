"""The commands that ask the tables: `query`, `schema`."""

from __future__ import annotations

import difflib
import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import Annotated, BinaryIO, cast

import typer

from t6gps.service import config as configuration
from t6gps.service.api import asking
from t6gps.service.api.asking import Parameter
from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, Json, Root, Server
from t6gps.service.views import terminal
from t6gps.storage import durable
from t6gps.storage.errors import ConfigError
from t6gps.storage.sql import views

OUT_FORMS = (".parquet", ".csv", ".json", ".arrow")
"""Ends of the names of files that a query writes."""
SCHEMA_COLUMNS = {"column_name": "column", "type": "type", "unit": "unit", "meaning": "meaning"}


class QueryFormat(StrEnum):
    """Formats of a query's result."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    ARROW = "arrow"


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (query, schema):
        app.command()(command)


def query(
    runs: Annotated[str, typer.Argument(metavar="RUN|PATTERN", help="A run, or a pattern such as 'rough-*'.")],
    sql: Annotated[str | None, typer.Argument(metavar="SQL", help="One SELECT (docs/queries.md); - reads it.")] = None,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    file: Annotated[Path | None, typer.Option(help="Read the SQL from a file.")] = None,
    params: Annotated[
        list[str] | None, typer.Option("--param", metavar="NAME=VALUE", help="A value of $NAME in the SQL.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write FILE.parquet, .csv, .json or .arrow.")] = None,
    form: Annotated[QueryFormat, typer.Option("--format", help="How to print the result.")] = QueryFormat.TABLE,
) -> None:
    """Query the stored trajectories of a run, or of many, with SQL."""
    written = None if out is None else _form(out, form)
    text, parameters = _sql(sql, file), _parameters(params or [])
    with door.opened(root, server) as there:
        if out is not None and written is not None:
            with _whole_file(out) as sink:
                there.write(runs, text, parameters, written, sink, terminal.warn)
            typer.echo(out)
        elif form is QueryFormat.TABLE:
            terminal.print_head(there.head(runs, text, parameters, terminal.warn))
        else:
            there.write(runs, text, parameters, form.value, sys.stdout.buffer, terminal.warn)


def _sql(sql: str | None, file: Path | None) -> str:
    """The text of a query. ConfigError unless there is one, or where it cannot be read."""
    if (sql is None) == (file is None):
        raise ConfigError("query takes either SQL or --file; - in the place of SQL reads it from the standard input")
    try:
        if sql is None:
            return Path(file or "").read_text(encoding="utf-8-sig")
        return sys.stdin.read() if sql == "-" else sql
    except OSError as error:
        raise ConfigError(f"cannot read SQL from {file}: {error.strerror}; name an existing file") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"SQL from {file or 'the standard input'} is not UTF-8: {error}; save it as UTF-8") from None


def _parameters(params: list[str]) -> dict[str, Parameter]:
    """The values of $names. ConfigError where one of them has two."""
    found = dict[str, Parameter]()
    for name, value in map(_parameter, params):
        if name in found:
            raise ConfigError(f"--param {name} is given twice: {found[name]!r}, then {value!r}; give it one value")
        found[name] = value
    return found


def _parameter(param: str) -> tuple[str, Parameter]:
    """Name and value of --param. ConfigError for another form, or a value that SQL does not take."""
    name, equals, _ = param.partition("=")
    if not equals or not name.strip().isidentifier():
        raise ConfigError(f"--param takes NAME=VALUE, found {param!r}; for example --param seed=3 for $seed")
    name, value = configuration.assigned(param)
    for item in value if isinstance(value, list) else [value]:
        if not isinstance(item, bool | int | float | str):
            raise ConfigError(
                f"--param {name} takes a number, text, true, false, or a list of them, found {value!r}; put text in "
                "quotes, and use CAST in the SQL for other types"
            )
    return name, cast(Parameter, value)


def _form(out: Path, form: QueryFormat) -> str:
    """The form that a file's name asks for. ConfigError for another, or one beside --format."""
    if form is not QueryFormat.TABLE:
        raise ConfigError(f"--out writes {out} in the form that its name says; leave out --format")
    if out.suffix not in OUT_FORMS:
        raise ConfigError(f"--out writes {', '.join(f'FILE{end}' for end in OUT_FORMS)}, found {out}; rename it")
    return out.suffix.removeprefix(".")


@contextmanager
def _whole_file(out: Path) -> Iterator[BinaryIO]:
    """A file that has its name when everything in it is written. ConfigError where it cannot be written."""
    hidden = durable.hidden(out)
    try:
        with hidden.open("wb") as sink:
            yield sink
        durable.publish(out)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}; name a file in a folder with room") from None
    finally:
        hidden.unlink(missing_ok=True)


def schema(
    table: Annotated[str | None, typer.Argument(metavar="TABLE", help="A table or view; all by default.")] = None,
    as_json: Json = False,
) -> None:
    """List the columns of tables and views that queries may ask: type, unit and meaning."""
    known = views.asked(asking.ABOUT.columns)
    if table is not None and table not in known:
        close = difflib.get_close_matches(table, known, n=1)
        hint = f"did you mean {close[0]}? " if close else ""
        raise ConfigError(f"there is no table {table!r}; {hint}tables: {', '.join(known)}")
    rows = views.described(known if table is None else {table: known[table]}).to_pylist()
    if as_json:
        typer.echo(json.dumps(rows, indent=2))
        return
    for name in known if table is None else [table]:
        of_table = [row for row in rows if row["table_name"] == name]
        terminal.print_rows(name, of_table, {key: (heading, "{}") for key, heading in SCHEMA_COLUMNS.items()})

"""The commands that read what is stored: `runs`, `show`, `query`, `render`; `schema` and `export` need no run."""

from __future__ import annotations

import difflib
import json
import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import Annotated, BinaryIO, cast

import typer

from t6gps.service import config as configuration
from t6gps.service.api import asking
from t6gps.service.api.asking import Parameter
from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, Json, Overrides, Root, RunName, Server
from t6gps.service.training import evaluation_records, origin, session
from t6gps.service.training.summary import RunSummary
from t6gps.service.views import terminal
from t6gps.service.views.diagnosis import diagnose
from t6gps.storage import catalog, durable, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError
from t6gps.storage.sql import views

EXPORT_SECTIONS = ("robot.", "terrain.")
OUT_FORMS = (".parquet", ".csv", ".json", ".arrow")
"""Ends of the names of files that a query writes."""
SCHEMA_COLUMNS = {"column_name": "column", "type": "type", "unit": "unit", "meaning": "meaning"}


class ExportFormat(StrEnum):
    """Formats in which the robot leaves."""

    MJCF = "mjcf"


class QueryFormat(StrEnum):
    """Formats of a query's result."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    ARROW = "arrow"


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (runs, show, query, schema, render, export):
        app.command()(command)


def runs(
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    size: Annotated[bool, typer.Option("--size", help="Say how much room each takes.")] = False,
) -> None:
    """List the runs."""
    if size and server is not None:
        raise ConfigError("--size measures folders of this machine; leave out --size or --server")
    with door.opened(root, server) as there:
        summaries = there.runs()
    columns = {"name": ("run", "{}"), "iterations": ("iterations", "{}")}
    columns |= {key: terminal.LEARNING_COLUMNS[key] for key in ("cost", "forward_speed_m_per_s")}
    rows = [asdict(run) | {"iterations": _iterations(run)} for run in summaries]
    if size:
        columns["mb"] = ("MB", "{:.1f}")
        for row in rows:
            row["mb"] = catalog.size(Run(catalog.whole(root) / row["name"])) / 1e6
    terminal.print_rows(f"Runs in {root}" if server is None else f"Runs of {server}", rows, columns)
    for run in summaries:
        if run.fault is not None:
            typer.echo(f"damaged: {run.fault}")


def _iterations(run: RunSummary) -> str:
    return "damaged" if run.fault is not None else f"{run.done} of {run.planned}"


def show(run_name: RunName, root: Root = DEFAULT_ROOT, server: Server = None) -> None:
    """Show a run: learning curve, segment classes of the last iteration, diagnosis, evaluation, files."""
    with door.opened(root, server) as there:
        iterations = there.table(run_name, "iterations").sort_by("iteration").to_pylist()
        if not iterations:
            typer.echo(f"run {run_name} has not finished an iteration yet")
            return
        classes, result = there.table(run_name, "classes").to_pylist(), there.evaluation(run_name)
    terminal.print_rows(f"Run {run_name}", iterations, terminal.LEARNING_COLUMNS)
    last = max((row["iteration"] for row in classes), default=-1)
    rows = [row | {"kind": ("Delta", "Lambda")[row["kind"]]} for row in classes if row["iteration"] == last]
    terminal.print_rows(f"Segment classes of iteration {last}", rows, terminal.CLASS_COLUMNS)
    typer.echo("\n".join(["Diagnosis:", *(f"  {sentence}" for sentence in diagnose(iterations, classes)), ""]))
    if result:
        terminal.print_evaluation(result)
    if server is None:
        run = catalog.open_run(root, run_name)
        print_paths(run, sorted(run.figures.glob("*.png")), root)


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
    text, parameters = _sql(sql, file), dict(_parameter(param) for param in params or [])
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
        return sys.stdin.read() if sql == "-" else sql or Path(file or "").read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"cannot read SQL from {file}: {error.strerror}; name an existing file") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"SQL from {file or 'the standard input'} is not UTF-8: {error}; save it as UTF-8") from None


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


def render(
    run_name: RunName,
    episode: Annotated[int, typer.Argument(min=0, help="Episode id (see the table `episodes`).")],
    out: Annotated[Path, typer.Option("--out", help="FILE.png or FILE.mp4.")],
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    evaluation_id: Annotated[
        int | None, typer.Option("--evaluation", min=0, help="Evaluation that the episode is of.")
    ] = None,
    step: Annotated[int | None, typer.Option(min=0, help="Control step of a still.")] = None,
    strip: Annotated[int | None, typer.Option(min=1, help="Snapshots in a strip.")] = None,
) -> None:
    """Draw a stored episode from its recorded states: a still, a strip of snapshots, or a film."""
    from t6gps.workers.ground.ground import ground
    from t6gps.workers.pictures import render as rendering
    from t6gps.workers.pictures.scene import Sizes

    if server is not None and evaluation_id is not None:
        raise ConfigError("--evaluation draws from a run of this machine; bring it here with t6gps fetch")
    with door.opened(root, server) as there, there.at_hand(run_name) as run:
        config = origin.configured(run) if evaluation_id is None else evaluation_records.world(run, evaluation_id)
        stored = there.episode(run_name, episode, evaluation_id)
        row = stored.summary.to_pylist()[0]
        session.tell_changes(run, terminal.warn)
        terrain = ground(config.terrain, row["terrain_seed"], row["terrain_difficulty"])
        sizes = Sizes(config.robot.bar_radius_m, config.task.waypoint_radius_m)
        with terminal.task("rendering") as progress:
            rendering.render(stored.frames, terrain, out, sizes, step=step, strip=strip, progress=progress)
    typer.echo(out)


def export(
    form: Annotated[ExportFormat, typer.Argument(metavar="mjcf", help="MuJoCo's model format.")],
    out: Annotated[Path, typer.Argument(metavar="FILE.xml", help="File to write.")],
    terrain_seed: Annotated[int, typer.Option(min=0, help="Seed of rough ground (--set terrain.difficulty=1).")] = 0,
    root: Root = DEFAULT_ROOT,
    overrides: Overrides = None,
) -> None:
    """Write the robot and its ground as a model for other tools."""
    from t6gps.workers.ground.ground import ground
    from t6gps.workers.physics.mjcf import to_mjcf

    configuration.check_keys(
        overrides or [], f"export {form.value}", EXPORT_SECTIONS, "the model has only a robot and its ground"
    )
    config = configuration.parse("{}", overrides or [], "--set")
    text = to_mjcf(config.robot, ground(config.terrain, terrain_seed, config.terrain.difficulty))
    try:
        out.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}; name a file in an existing folder") from None
    typer.echo(out)


def print_learning(run: Run) -> None:
    """Print the learning curve of a run."""
    rows = tables.read(run, "iterations").sort_by("iteration").to_pylist()
    terminal.print_rows(f"Run {run.name}", rows, terminal.LEARNING_COLUMNS)


def print_paths(run: Run, pictures: Sequence[Path], root: Path) -> None:
    """Print where a run's files lie, and commands to try next."""
    place = f" --root {shlex.quote(str(root))}" if root != DEFAULT_ROOT else ""
    lines = [
        f"dataset      {run.tables}",
        f"checkpoints  {run.checkpoints}",
        *(f"figure       {picture}" for picture in pictures),
        "",
        "Try next:",
        f"  t6gps eval {run.name} --episodes 40 --seed 7{place}",
        f'  t6gps query {run.name} "SELECT iteration, avg(forward_speed_m_per_s) AS m_per_s FROM episodes '
        f'GROUP BY iteration ORDER BY iteration"{place}',
        f"  t6gps render {run.name} 0 --out episode.mp4{place}",
    ]
    typer.echo("\n".join(lines))

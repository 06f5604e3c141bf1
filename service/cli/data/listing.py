"""The commands that list what is stored: `runs`, `show`."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, Root, RunName, Server
from t6gps.service.training.summary import RunSummary
from t6gps.service.views import terminal
from t6gps.service.views.diagnosis import diagnose
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError
from t6gps.workers.robot.topology import KIND_NAMES


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (runs, show):
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
    rows = [row | {"kind": KIND_NAMES[row["kind"]]} for row in classes if row["iteration"] == last]
    terminal.print_rows(f"Segment classes of iteration {last}", rows, terminal.CLASS_COLUMNS)
    typer.echo("\n".join(["Diagnosis:", *(f"  {sentence}" for sentence in diagnose(iterations, classes)), ""]))
    if result:
        terminal.print_evaluation(result)
    if server is None:
        run = catalog.open_run(root, run_name)
        print_paths(run, sorted(run.figures.glob("*.png")), root)


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

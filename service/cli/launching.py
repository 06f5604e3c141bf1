"""The commands for jobs, the same for every target: `submit`, `jobs`, `logs`, `fetch`.

`status`, `scale` and `stop` take a job's name too; `live` has them.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli import door
from t6gps.service.cli.options import (
    DEFAULT_ROOT,
    INTERRUPTED,
    Autoscale,
    JobName,
    Json,
    Overrides,
    Publish,
    Root,
    Server,
    Workers,
    with_workers,
)
from t6gps.service.launch import fetch as fetching
from t6gps.service.launch import launchers, submission
from t6gps.service.launch import target as targets
from t6gps.service.launch.target import Kind
from t6gps.service.views import terminal

JOB_COLUMNS = {
    "name": ("job", "{}"),
    "kind": ("on", "{}"),
    "native_id": ("number", "{}"),
    "state": ("state", "{}"),
    "detail": ("", "{}"),
    "run": ("run", "{}"),
    "root": ("root", "{}"),
    "submitted": ("submitted", "{:.19}"),
}


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (submit, jobs, logs, fetch):
        app.command()(command)


def submit(
    source: Annotated[str, typer.Argument(metavar="PRESET|FILE.toml", help="Preset name or TOML file.")],
    to: Annotated[Kind, typer.Option("--to", help="Where the job shall run.")] = Kind.LOCAL,
    target_file: Annotated[
        Path | None, typer.Option("--target", envvar="T6GPS_TARGET", help="TOML file with a section for each target.")
    ] = None,
    run_name: Annotated[str | None, typer.Option("--run", help="Name of the run; by default the preset's.")] = None,
    root: Root = DEFAULT_ROOT,
    workers: Workers = None,
    autoscale: Autoscale = None,
    seeds: Annotated[
        int | None, typer.Option(min=2, max=1000, help="As many runs, RUN-seed0 and so on, with training seeds from 0.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a run whose job has ended.")] = False,
    publish: Publish = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what would be done, and do nothing.")] = False,
    overrides: Overrides = None,
) -> None:
    """Train in a job: in the background, or on a cluster."""
    target = targets.read(to, None if to is Kind.LOCAL else target_file)
    launcher = launchers.of(target)
    changes = with_workers(overrides, workers, autoscale)
    planned = submission.plan(source, changes, root, run_name, seeds, resume, publish)
    if dry_run:
        published = "" if publish is None else f"# each run is published below {publish}\n"
        typer.echo(
            f"# {planned[0].folder.config}\n{planned[0].config.to_toml()}\n{published}{launcher.render(planned)}"
        )
        return
    launcher.check(planned)
    for job in submission.submit(launcher, to, target, source, planned):
        typer.echo(f"job {job.name} is submitted to {job.kind} as {job.native_id}; follow it: t6gps logs -f {job.name}")


def jobs(server: Server = None, as_json: Json = False) -> None:
    """List the jobs that you have submitted, or those of a server's runs, and how each is."""
    with door.opened(DEFAULT_ROOT, server) as there:
        rows = [job.model_dump(mode="json") for job in there.jobs()]
    if as_json:
        typer.echo(json.dumps(rows))
    else:
        terminal.print_rows("Jobs", rows, JOB_COLUMNS)


def logs(
    name: JobName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until the job has ended.")] = False,
) -> None:
    """Print what a job has written."""
    try:
        with door.opened(root, server) as there:
            for text in there.logs(name, follow):
                typer.echo(text, nl=False)
                sys.stdout.flush()
    except KeyboardInterrupt:  # of the watching; the job goes on
        raise typer.Exit(INTERRUPTED) from None


def fetch(
    name: JobName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    to: Annotated[Path, typer.Option("--to", help="Folder that shall hold the run.")] = DEFAULT_ROOT,
    run_name: Annotated[str | None, typer.Option("--run", help="Name that it gets; by default its own.")] = None,
) -> None:
    """Bring a run home: whole, verified, and continued where an earlier copy was cut off."""
    with (
        door.opened(root, server) as there,
        there.source(name) as (source, own),
        terminal.task("fetching") as progress,
    ):
        copy = fetching.fetch(source, to, run_name or own, progress)
    typer.echo(copy.path)

"""The commands for jobs, the same for every target: `submit`, `jobs`, `logs`, `stop`, `fetch`.

`status` and `scale` take a job's name too; `live` has them.
"""

from __future__ import annotations

import json
import time
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli.options import DEFAULT_ROOT, Autoscale, Json, Overrides, Root, Workers, with_workers
from t6gps.service.launch import fetch as fetching
from t6gps.service.launch import job as records
from t6gps.service.launch import launchers, submission
from t6gps.service.launch import target as targets
from t6gps.service.launch.fetch import FolderSource, Source
from t6gps.service.launch.job import ENDED, Job, JobState
from t6gps.service.launch.launcher import Launcher
from t6gps.service.launch.target import Kind
from t6gps.service.steering import requests
from t6gps.service.views import terminal
from t6gps.storage import catalog
from t6gps.storage.errors import RunError, T6GpsError

CANCEL_S, TICK_S = 60.0, 0.2
"""How long a job has that is ended, and how often it is looked at."""
INTERRUPTED = 130
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

JobName = Annotated[str, typer.Argument(metavar="JOB|RUN", help="Name of a job (see `t6gps jobs`), or of its run.")]


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (submit, jobs, logs, stop, fetch):
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
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print what would be done, and do nothing.")] = False,
    overrides: Overrides = None,
) -> None:
    """Train in a job: in the background, or on a cluster."""
    target = targets.read(to, None if to is Kind.LOCAL else target_file)
    launcher = launchers.of(target)
    planned = submission.plan(source, with_workers(overrides, workers, autoscale), root, run_name, seeds, resume)
    if dry_run:
        typer.echo(f"# {planned[0].folder.config}\n{planned[0].config.to_toml()}\n{launcher.render(planned)}")
        return
    launcher.check(planned[0].config)
    for job in submission.submit(launcher, to, target, source, planned):
        typer.echo(f"job {job.name} is submitted to {job.kind} as {job.native_id}; follow it: t6gps logs -f {job.name}")


def jobs(as_json: Json = False) -> None:
    """List the jobs that you have submitted, and how each is."""
    rows = [_row(job) for job in records.jobs()]
    if as_json:
        typer.echo(json.dumps(rows))
    else:
        terminal.print_rows("Jobs", rows, JOB_COLUMNS)


def logs(
    name: JobName,
    root: Root = DEFAULT_ROOT,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until the job has ended.")] = False,
) -> None:
    """Print what a job has written."""
    job = submission.named(root, name)
    try:
        for text in launchers.serving(job).logs(job, follow):
            typer.echo(text, nl=False)
    except KeyboardInterrupt:  # of the watching; the job goes on
        raise typer.Exit(INTERRUPTED) from None


def stop(
    name: JobName,
    root: Root = DEFAULT_ROOT,
    deadline_s: Annotated[float, typer.Option("--deadline", min=0.0, help="How long to wait for it (s).")] = (
        requests.STOP_DEADLINE_S
    ),
) -> None:
    """Stop a run as Ctrl-C does, and end the job that does not stop. Everything sampled is kept."""
    if records.find(root, name) is None and catalog.exists(root, name):
        typer.echo(f"run {name}: {requests.stop(catalog.open_run(root, name), deadline_s)}")
        return
    job = submission.named(root, name)
    launcher = launchers.serving(job)
    state, _ = launcher.state(job)
    if state in ENDED:
        raise RunError(f"job {job.name} is {state} already; there is nothing to stop")
    launcher.stop(job)
    ended = _ended(launcher, job, deadline_s)
    if ended is None:
        terminal.warn(f"job {job.name} has not stopped within {deadline_s:.0f} s; it is ended")
        launcher.cancel(job)
        ended = _ended(launcher, job, CANCEL_S)
    if ended is None:
        raise RunError(f"job {job.name} ({job.kind} {job.native_id}) does not end; see its target")
    typer.echo(f"job {job.name} is {ended}; resume with t6gps submit --resume, and the settings it had")


def fetch(
    name: JobName,
    root: Root = DEFAULT_ROOT,
    to: Annotated[Path, typer.Option("--to", help="Folder that shall hold the run.")] = DEFAULT_ROOT,
    run_name: Annotated[str | None, typer.Option("--run", help="Name that it gets; by default its own.")] = None,
) -> None:
    """Bring a run home: whole, verified, and continued where an earlier copy was cut off."""
    job = records.find(root, name)
    opened: AbstractContextManager[Source] = (
        nullcontext(FolderSource(catalog.open_run(root, name))) if job is None else launchers.serving(job).source(job)
    )
    with opened as source, terminal.task("fetching") as progress:
        copy = fetching.fetch(source, to, run_name or (name if job is None else job.run), progress)
    typer.echo(copy.path)


def _row(job: Job) -> dict[str, object]:
    """A job in a line, also where its target cannot be asked."""
    try:
        state, detail = submission.state_of(job)
    except T6GpsError as error:  # one target that does not answer hides none of the others
        state, detail = None, str(error)
    return {**job.model_dump(mode="json", exclude={"target"}), "state": state, "detail": detail}


def _ended(launcher: Launcher, job: Job, deadline_s: float) -> JobState | None:
    """How a job ended, None where it has not by the deadline."""
    deadline = time.monotonic() + deadline_s
    while time.monotonic() < deadline:
        state, _ = launcher.state(job)
        if state in ENDED:
            return state
        time.sleep(TICK_S)
    return None

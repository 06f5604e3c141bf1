"""The commands that look after data: `verify`, `repair`, `cp`, `mv`, `rm`."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli.options import DEFAULT_ROOT, Json, Root, RunName
from t6gps.service.training import copying, verification
from t6gps.service.views import terminal
from t6gps.storage import catalog
from t6gps.storage.care import repair as repairing
from t6gps.storage.care.fault import Fault, Progress
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, StoreError, T6GpsError

EXIT_DAMAGED = 2
NewName = Annotated[str, typer.Argument(metavar="NEW", help="Name that it gets.")]
To = Annotated[Path | None, typer.Option("--to", help="Folder of runs that it goes to; by default the same.")]
CopyTo = Annotated[
    Path | None,
    typer.Option(
        "--to",
        metavar="FOLDER|s3://BUCKET/PREFIX",
        help="Folder or object store that it goes to; by default the same.",
    ),
]


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (verify, repair):
        app.command()(command)
    for name, function in (("cp", copy), ("mv", move), ("rm", remove)):
        app.command(name)(function)


def verify(
    names: Annotated[
        list[str] | None, typer.Argument(metavar="[RUN...]", help="Names of runs; by default all.")
    ] = None,
    root: Root = DEFAULT_ROOT,
    as_json: Json = False,
) -> None:
    """Check every file of runs against what was written; exit with 2 where one has a fault."""
    runs = [catalog.open_run(root, name) for name in names] if names else catalog.list_runs(root)
    if not runs:
        raise RunError(f"{root} holds no runs; check the root, or start a run")
    found = {}
    for run in runs:
        with terminal.task(f"verifying {run.name}") as progress:
            found[run.name] = _faults(run, progress)
        if not as_json:
            faults = found[run.name]
            typer.echo("\n".join(f"{run.name}: {fault}" for fault in faults) if faults else f"{run.name}: sound")
    if as_json:
        typer.echo(json.dumps({"runs": {name: [asdict(fault) for fault in faults] for name, faults in found.items()}}))
    if any(found.values()):
        raise typer.Exit(EXIT_DAMAGED)


def _faults(run: Run, progress: Progress) -> list[Fault]:
    """The faults of a run; what keeps it from being read hides no other run. StoreError as for all runs."""
    try:
        return verification.verify(run, progress)
    except StoreError:
        raise
    except (T6GpsError, OSError) as error:
        return [Fault("run", ".", f"it cannot be read: {error}")]


def repair(
    run_name: RunName,
    source: Annotated[Path | None, typer.Option("--from", metavar="ROOT/RUN", help="A sound copy of the run.")] = None,
    root: Root = DEFAULT_ROOT,
) -> None:
    """Mend a run from its own files or a copy, set aside what cannot be mended, and say what is lost."""
    run = catalog.open_run(root, run_name)
    copy = None if source is None else catalog.open_run(source.parent, source.name)
    with terminal.task(f"repairing {run.name}"):
        done = repairing.repair(run, copy, verification.verify)
    typer.echo("\n".join(done.sentences) or f"{run.name}: sound; nothing to repair")
    for fault in done.left:
        typer.echo(f"not repaired: {fault}")
    if done.left:
        raise RunError(f"run {run.name} is still damaged; repair it --from a sound copy")


def copy(run_name: RunName, new: NewName, to: CopyTo = None, root: Root = DEFAULT_ROOT) -> None:
    """Copy a run that nobody uses, whole or not at all; into an object store, or from there."""
    with terminal.task(f"copying {run_name}") as progress:
        typer.echo(copying.copy(catalog.open_run(root, run_name), to or root, new, progress).path)


def move(run_name: RunName, new: NewName, to: To = None, root: Root = DEFAULT_ROOT) -> None:
    """Give a run that nobody uses another name or root."""
    with terminal.task(f"moving {run_name}"):
        typer.echo(catalog.move(catalog.open_run(root, run_name), to or root, new).path)


def remove(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Remove a run that nobody uses, after asking; nothing brings it back."""
    run = catalog.open_run(root, run_name)
    if not yes:
        if not sys.stdin.isatty():
            raise RunError(f"run {run.name} is removed for good, and nobody can be asked here; add --yes")
        if not typer.confirm(f"Remove {run.path}, {catalog.size(run) / 1e6:.1f} MB, for good?"):
            typer.echo(f"run {run.name} stays")
            return
    catalog.remove(run)

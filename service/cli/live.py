"""The commands of someone who looks after a run that goes on: `scale`, `status`, `replay`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer

from t6gps.service.pool import control, crash_bundle
from t6gps.service.pool.attempt import Failure
from t6gps.service.views import terminal
from t6gps.service.views.terminal import console
from t6gps.storage import catalog
from t6gps.storage.catalog import Run

Root = Annotated[Path, typer.Option("--root", envvar="T6GPS_ROOT", help="Folder that holds the runs.")]
RunName = Annotated[str, typer.Argument(metavar="RUN", help="Name of a run (see `t6gps runs`).")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
DEFAULT_ROOT = Path("runs")

WORKER_COLUMNS = {
    "slot": ("slot", "{:d}"),
    "incarnation": ("incarnation", "{:d}"),
    "pid": ("process", "{}"),
    "node": ("node", "{}"),
    "phase": ("phase", "{}"),
    "for_s": ("for s", "{:.1f}"),
    "episodes": ("episodes", "{}"),
}


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    app.command(context_settings={"ignore_unknown_options": True})(scale)  # so that -1 is a number, and refused as one
    for command in (status, replay):
        app.command()(command)


def scale(
    run_name: RunName,
    workers: Annotated[int, typer.Argument(metavar="N", help="Workers from now on; 0 pauses the run.")],
    root: Root = DEFAULT_ROOT,
    deadline_s: Annotated[float, typer.Option("--deadline", min=0.0, help="How long to wait for them (s).")] = (
        control.SCALE_DEADLINE_S
    ),
) -> None:
    """Grow or shrink a run while it goes on; its data stay the same."""
    reached = control.scale(catalog.open_run(root, run_name), workers, deadline_s)
    typer.echo(f"run {run_name} has {reached['ready']} workers ({reached['state']})")


def status(run_name: RunName, root: Root = DEFAULT_ROOT, as_json: Json = False) -> None:
    """Say how a run is: its workers, what is under way, who waits for whom and since when."""
    found = control.status(catalog.open_run(root, run_name))
    if as_json:
        typer.echo(json.dumps(found))
        return
    counts = {**found["episodes"], **found["processes"]}
    waits = [f"{wait['what']} since {wait['for_s']:.1f} s" for wait in found["waits"]]
    lines = [
        f"run {run_name}: {found['state']}" + (f", {found['reason']}" if found["reason"] else ""),
        f"{found['phase']}: {found['backlog']} episodes to go, {found['leases']} leased, "
        f"{found['bytes_in_flight'] / 1e6:.1f} MB in flight; {found['ready']} of {found['wanted']} workers ready",
        ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()),
        *waits,
    ]
    if found["quarantined"]:
        lines.append(f"left out for their failures: episodes {', '.join(map(str, found['quarantined']))}")
    typer.echo("\n".join(lines))
    if found["workers"]:
        terminal.print_rows("Workers", [dict(worker) for worker in found["workers"]], WORKER_COLUMNS)


def replay(
    path: Annotated[Path, typer.Argument(metavar="BUNDLE", help="RUN/bundles/episode-N.json")], as_json: Json = False
) -> None:
    """Run an episode that failed once more, alone and in this process, and say what happens."""
    kept = crash_bundle.read(path)
    result = crash_bundle.replay(kept)
    found: dict[str, Any] = {"episode": kept.plan.episode_id, "then": [f["message"] for f in kept.failures]}
    if isinstance(result, Failure):
        found |= {"now": "failed", **asdict(result)}
    else:
        summary = result.summary.to_pylist()[0]
        found |= {"now": "succeeded", **{key: summary[key] for key in ("steps", "ended_by", "cost")}}
    if as_json:
        typer.echo(json.dumps(found))
        return
    for number, failure in enumerate(kept.failures, 1):
        typer.echo(f"then, attempt {number}: {failure['error']}: {failure['message']}")
    if isinstance(result, Failure):
        typer.echo(f"now: {result}\n{result.trace}")
    else:
        typer.echo(f"now: {found['steps']} steps, {found['ended_by']}, cost {found['cost']:.3f}")


def say_what_is_left_out(run: Run) -> None:
    """Name the episodes of a run that are in quarantine, and how to look into them."""
    for purpose in ("episode", "evaluation"):
        for number in sorted(crash_bundle.kept(run.bundles, purpose)):
            path = run.bundles / f"{purpose}-{number}.json"
            console.print(
                f"{purpose} {number} failed again and again and is left out; look into it with: t6gps replay {path}",
                highlight=False,
                soft_wrap=True,
            )

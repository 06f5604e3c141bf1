"""The commands for a run that is running, and for what it had to set aside: `scale`, `stop`, `status`, `replay`."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, Json, Root, RunName, Server
from t6gps.service.launch import job as records
from t6gps.service.launch import launchers
from t6gps.service.pool import crash_bundle
from t6gps.service.pool.attempt import Failure
from t6gps.service.steering import events as happened
from t6gps.service.steering import requests
from t6gps.service.steering.status import Status
from t6gps.service.views import terminal
from t6gps.storage import catalog
from t6gps.storage.catalog import Run

Deadline = Annotated[float, typer.Option("--deadline", min=0.0, help="How long to wait for that (s).")]
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
    for command in (pause, unpause, status, events, replay):
        app.command()(command)


def scale(
    run_name: RunName,
    workers: Annotated[int, typer.Argument(metavar="N", help="Workers from now on; 0 pauses the run.")],
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    deadline_s: Deadline = requests.SCALE_DEADLINE_S,
) -> None:
    """Grow or shrink a running run; its data stay the same."""
    job = None if server else records.find(root, run_name)
    if job is None:
        with door.opened(root, server) as runs:
            reached = runs.scale(run_name, workers, deadline_s)
    else:
        reached = launchers.serving(job).scale(job, workers, deadline_s)
    _tell_reached(run_name, reached)


def pause(run_name: RunName, root: Root = DEFAULT_ROOT, deadline_s: Deadline = requests.SCALE_DEADLINE_S) -> None:
    """Give a running run no workers for now; `unpause` gives it what it had."""
    _tell_reached(run_name, requests.pause(catalog.open_run(root, run_name), deadline_s))


def unpause(run_name: RunName, root: Root = DEFAULT_ROOT, deadline_s: Deadline = requests.SCALE_DEADLINE_S) -> None:
    """Give a paused run the workers, or the autoscaling, that it had."""
    _tell_reached(run_name, requests.unpause(catalog.open_run(root, run_name), deadline_s))


def _tell_reached(run_name: str, reached: Status) -> None:
    typer.echo(f"run {run_name} has {reached['ready']} workers ({reached['state']})")


def status(run_name: RunName, root: Root = DEFAULT_ROOT, server: Server = None, as_json: Json = False) -> None:
    """Say how a run is: its workers, what is under way, who waits for whom and since when."""
    job = None if server else records.find(root, run_name)
    if job is None:
        with door.opened(root, server) as runs:
            _print_status(run_name, runs.status(run_name), as_json)
        return
    launcher = launchers.serving(job)
    known, (state, detail) = launcher.status(job), launcher.state(job)
    if as_json:
        typer.echo(json.dumps({"job": {"name": job.name, "state": state, "detail": detail}, **(known or {})}))
        return
    typer.echo(f"job {job.name} on {job.kind} ({job.native_id}): {state}" + (f", {detail}" if detail else ""))
    if known is not None:
        _print_status(job.run, known, as_json)


def _print_status(run_name: str, state: Status, as_json: bool) -> None:
    """Print how a run is, in lines and a table of its workers, or as JSON."""
    if as_json:
        typer.echo(json.dumps(state))
        return
    counts = {**state["episodes"], **state["processes"]}
    waits = [f"{wait['what']} since {wait['for_s']:.1f} s" for wait in state["waits"]]
    lines = [
        f"run {run_name}: {state['state']}" + (f", {state['reason']}" if state["reason"] else ""),
        f"{state['phase']}: {state['backlog']} episodes to go, {state['leases']} leased, "
        f"{state['bytes_in_flight'] / 1e6:.1f} MB in flight; {state['ready']} of {state['wanted']} workers ready",
        ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()),
        *waits,
    ]
    if state["quarantined"]:
        lines.append(f"quarantined for their failures: episodes {', '.join(map(str, state['quarantined']))}")
    typer.echo("\n".join(lines))
    if state["workers"]:
        terminal.print_rows("Workers", [dict(worker) for worker in state["workers"]], WORKER_COLUMNS)


def events(run_name: RunName, root: Root = DEFAULT_ROOT, as_json: Json = False) -> None:
    """Say what happened to a run: starts, scaling, failures, replacements, each with its reason."""
    found = happened.read(catalog.open_run(root, run_name))
    if as_json:
        typer.echo(json.dumps({"events": found}))
        return
    for event in found:
        typer.echo(f"{event['time']}  {event['event']:<11}  {event['phase']}: {event['reason']}")


def replay(
    path: Annotated[Path, typer.Argument(metavar="BUNDLE", help="RUN/bundles/episode-N.json")], as_json: Json = False
) -> None:
    """Run an episode that failed once more, alone and in this process, and say what happens."""
    bundle = crash_bundle.read(path)
    result = crash_bundle.replay(bundle)
    if isinstance(result, Failure):
        now, text = {"now": "failed", **asdict(result)}, f"{result}\n{result.trace}"
    else:
        row = result.summary.to_pylist()[0]
        now = {"now": "succeeded", **{key: row[key] for key in ("steps", "ended_by", "cost")}}
        text = f"{row['steps']} steps, {row['ended_by']}, cost {row['cost']:.3f}"
    if as_json:
        then = [failure["message"] for failure in bundle.failures]
        typer.echo(json.dumps({"episode": bundle.plan.episode_id, "then": then, **now}))
        return
    for number, failure in enumerate(bundle.failures, 1):
        typer.echo(f"then, attempt {number}: {failure['error']}: {failure['message']}")
    typer.echo(f"now: {text}")


def name_quarantined(run: Run) -> None:
    """Name the episodes of a run that are in quarantine, and how to look into them."""
    for purpose in ("episode", "evaluation"):
        for number in sorted(crash_bundle.kept(run.bundles, purpose)):
            path = run.bundles / f"{purpose}-{number}.json"
            terminal.say(
                f"{purpose} {number} failed again and again and is quarantined; look into it with: t6gps replay {path}"
            )

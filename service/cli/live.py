"""The commands for a run that is running, and for what it had to set aside: `scale`, `stop`, `status`, `replay`."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, INTERRUPTED, JobName, Json, Root, RunName, Server
from t6gps.service.pool import crash_bundle
from t6gps.service.pool.attempt import Failure
from t6gps.service.steering import requests
from t6gps.service.steering.status import Status
from t6gps.service.views import terminal
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
    for command in (pause, unpause, stop, status, events, replay):
        app.command()(command)


def scale(
    run_name: RunName,
    workers: Annotated[int, typer.Argument(metavar="N", help="Workers from now on; 0 pauses the run.")],
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    deadline_s: Deadline = requests.SCALE_DEADLINE_S,
) -> None:
    """Grow or shrink a running run; its data stay the same."""
    with door.opened(root, server) as there:
        _tell_reached(run_name, there.scale(run_name, workers, deadline_s))


def pause(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    deadline_s: Deadline = requests.SCALE_DEADLINE_S,
) -> None:
    """Give a running run no workers for now; `unpause` gives it what it had."""
    with door.opened(root, server) as there:
        _tell_reached(run_name, there.pause(run_name, deadline_s))


def unpause(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    deadline_s: Deadline = requests.SCALE_DEADLINE_S,
) -> None:
    """Give a paused run the workers, or the autoscaling, that it had."""
    with door.opened(root, server) as there:
        _tell_reached(run_name, there.unpause(run_name, deadline_s))


def _tell_reached(run_name: str, reached: Status) -> None:
    typer.echo(f"run {run_name} has {reached['ready']} workers ({reached['state']})")


def stop(
    name: JobName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    deadline_s: Annotated[float, typer.Option("--deadline", min=0.0, help="How long to wait for it (s).")] = (
        requests.STOP_DEADLINE_S
    ),
) -> None:
    """Stop a run as Ctrl-C does, and end the job that does not stop. Everything sampled is kept."""
    with door.opened(root, server) as there:
        typer.echo(there.stop(name, deadline_s, terminal.warn))


def status(name: JobName, root: Root = DEFAULT_ROOT, server: Server = None, as_json: Json = False) -> None:
    """Say how a run is: its workers, what is under way, who waits for whom and since when."""
    with door.opened(root, server) as there:
        standing = there.standing(name)
    job, known = standing.job, standing.status
    if as_json:
        said = {} if job is None else {"job": {"name": job.name, "state": job.state, "detail": job.detail}}
        typer.echo(json.dumps({**said, **(known or {})}))
        return
    if job is not None:
        detail = f", {job.detail}" if job.detail else ""
        typer.echo(f"job {job.name} on {job.kind} ({job.native_id}): {job.state}{detail}")
    if known is not None:
        _print_status(name if job is None else job.run, known)


def _print_status(run_name: str, state: Status) -> None:
    """Print how a run is, in lines and a table of its workers."""
    counts = {**state["episodes"], **state["processes"]}
    waits = [f"{wait['what']} since {wait['for_s']:.1f} s" for wait in state["waits"]]
    lines = [
        f"run {run_name}: {state['state']}" + (f", {state['reason']}" if state["reason"] else ""),
        f"{state['phase']}: {state['backlog']} episodes to go, {state['leases']} leased, "
        f"{state['bytes_in_flight'] / 1e6:.1f} MB in flight; {state['ready']} of {state['wanted']} workers ready",
        ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()),
        *waits,
    ]
    if "published" in state:
        copied = state["published"]
        trouble = f"; the last attempt: {copied['error']}" if copied["error"] else ""
        lines.append(
            f"published to {copied['to']}: {copied['iterations']} iterations, {copied['behind']} behind{trouble}"
        )
    if state["quarantined"]:
        lines.append(f"quarantined for their failures: episodes {', '.join(map(str, state['quarantined']))}")
    typer.echo("\n".join(lines))
    if state["workers"]:
        terminal.print_rows("Workers", [dict(worker) for worker in state["workers"]], WORKER_COLUMNS)


def events(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on with what happens, until Ctrl-C.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object, with -f one a line.")] = False,
) -> None:
    """Say what happened to a run: starts, scaling, failures, replacements, each with its reason."""
    with door.opened(root, server) as there:
        if as_json and not follow:
            typer.echo(json.dumps({"events": there.history(run_name)}))
            return
        try:
            for event in there.follow(run_name) if follow else there.history(run_name):
                line = f"{event['time']}  {event['event']:<11}  {event['phase']}: {event['reason']}"
                typer.echo(json.dumps(event) if as_json else line)
                sys.stdout.flush()
        except KeyboardInterrupt:  # of the watching; the run goes on
            raise typer.Exit(INTERRUPTED) from None


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

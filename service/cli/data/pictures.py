"""The command that draws stored episodes: `render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, Root, RunName, Server
from t6gps.service.training import evaluation_records, origin, session
from t6gps.service.views import terminal
from t6gps.storage.errors import ConfigError


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (render,):
        app.command()(command)


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

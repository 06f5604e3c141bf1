"""The commands that show stored episodes: `render` draws them, `view` opens them in the Rerun viewer."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import pyarrow.compute as pc
import typer

from t6gps.service.cli import door
from t6gps.service.cli.door import Door
from t6gps.service.cli.options import DEFAULT_ROOT, Root, RunName, Server
from t6gps.service.config import Config
from t6gps.service.training import evaluation_records, origin, session
from t6gps.service.views import picks, terminal
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import Episode

if TYPE_CHECKING:
    from t6gps.workers.ground.terrain import Terrain

EvaluationId = Annotated[int | None, typer.Option("--evaluation", min=0, help="Evaluation that the episodes are of.")]


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (render, view):
        app.command()(command)


def render(
    run_name: RunName,
    episode: Annotated[int, typer.Argument(min=0, help="Episode id (see the table `episodes`).")],
    out: Annotated[Path, typer.Option("--out", help="FILE.png or FILE.mp4.")],
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    evaluation_id: EvaluationId = None,
    step: Annotated[int | None, typer.Option(min=0, help="Control step of a still.")] = None,
    strip: Annotated[int | None, typer.Option(min=1, help="Snapshots in a strip.")] = None,
) -> None:
    """Draw a stored episode from its recorded states: a still, a strip of snapshots, or a film."""
    with door.opened(root, server) as there, there.at_hand(run_name) as run:
        config = _world(there, run, evaluation_id)
        stored = there.episode(run_name, episode, evaluation_id)
        session.tell_changes(run, terminal.warn)
        draw(config, stored, out, step, strip)
    typer.echo(out)


def draw(config: Config, episode: Episode, out: Path, step: int | None = None, strip: int | None = None) -> None:
    """Draw an episode that was run in the world of a configuration. ConfigError as for `workers.pictures.render`."""
    from t6gps.workers.pictures import render as rendering
    from t6gps.workers.pictures.scene import Sizes

    sizes = Sizes(config.robot.bar_radius_m, config.task.waypoint_radius_m, config.robot.attachment_span_m)
    with terminal.task("rendering") as progress:
        ground = _ground(config, episode)
        rendering.render(episode.frames, ground, out, sizes, step=step, strip=strip, progress=progress)


def view(
    run_name: RunName,
    episodes: Annotated[
        list[int] | None, typer.Argument(metavar="N...", min=0, help="Episode ids (see the table `episodes`).")
    ] = None,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    evaluation_id: EvaluationId = None,
    pick: Annotated[
        str | None, typer.Option("--pick", metavar="best:N,worst:N", help="Episodes by mean forward speed.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="FILE.rrd, or a folder for RUN-N.rrd; else the viewer opens.")
    ] = None,
) -> None:
    """Look at stored episodes in the Rerun viewer: robot, ground and numbers, step by step; or write them for it."""
    from t6gps.workers.pictures.viewer import files

    if out is None:
        files.check_display()
    with door.opened(root, server) as there, there.at_hand(run_name) as run:
        config = _world(there, run, evaluation_id)
        stored = [
            there.episode(run_name, number, evaluation_id)
            for number in _chosen(there, run_name, episodes or [], evaluation_id, pick)
        ]
        session.tell_changes(run, terminal.warn)
        of = "" if evaluation_id is None else f"evaluation-{evaluation_id}-"
        names = [f"{run_name}-{of}{episode.episode_id}" for episode in stored]
        if out is not None:
            written = files.planned(out, names)
            _record(config, stored, names, written)
            typer.echo("\n".join(map(str, written)))
            return
        with tempfile.TemporaryDirectory(prefix="t6gps-") as folder:
            written = files.planned(Path(folder), names)
            _record(config, stored, names, written)
            files.show(written)


def _chosen(there: Door, run: str, numbers: Sequence[int], evaluation_id: int | None, pick: str | None) -> list[int]:
    """The episodes that are named and picked, each once."""
    if pick is None:
        if not numbers:
            raise ConfigError("view needs episodes: name some, as in view RUN 3 7, or pick some with --pick best:1")
        return list(dict.fromkeys(numbers))
    if evaluation_id is None:
        known = there.table(run, "episodes")
    else:
        known = there.table(run, "evaluation_episodes")
        known = known.filter(pc.equal(known["evaluation_id"], evaluation_id))
    return list(dict.fromkeys([*numbers, *picks.picked(pick, known)]))


def _record(config: Config, episodes: Sequence[Episode], names: Sequence[str], paths: Sequence[Path]) -> None:
    """Write each episode as a recording."""
    from t6gps.workers.pictures.viewer import files
    from t6gps.workers.pictures.viewer.world import World

    try:
        from t6gps.workers.pictures.viewer.recording import recorded
    except ModuleNotFoundError as error:
        raise ConfigError(f"view needs {error.name}; install it with: pip install 't6gps[view]'") from None
    with terminal.task("recording") as progress:
        for done, (episode, name, file) in enumerate(zip(episodes, names, paths, strict=True)):
            world = World(config.robot, _ground(config, episode), config.task.waypoint_radius_m)
            files.write(file, recorded(name, episode, world))
            progress(done + 1, len(paths))


def _world(there: Door, run: Run, evaluation_id: int | None) -> Config:
    """The configuration of what was sampled in training, or in an evaluation."""
    if evaluation_id is None:
        return origin.configured(run)
    return evaluation_records.world(run, there.table(run.name, "evaluations"), evaluation_id)


def _ground(config: Config, episode: Episode) -> Terrain | None:
    """The ground of an episode, None for the plane."""
    from t6gps.workers.ground.ground import ground

    row = episode.summary.to_pylist()[0]
    return ground(config.terrain, row["terrain_seed"], row["terrain_difficulty"])

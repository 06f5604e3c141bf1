"""The commands that write files for other programs: `export mjcf`, and `export` of episodes in each format."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from t6gps.service import config as configuration
from t6gps.service.api import exporting
from t6gps.service.cli.options import DEFAULT_ROOT, Overrides, Root
from t6gps.service.views import terminal
from t6gps.storage.errors import ConfigError
from t6gps.storage.exports.dataset import FORMATS

EXPORT_SECTIONS = ("robot.", "terrain.")
export = typer.Typer(no_args_is_help=True, help="Write episodes, or the robot, for other programs.")


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    app.add_typer(export, name="export")


@export.command()
def mjcf(
    out: Annotated[Path, typer.Argument(metavar="FILE.xml", help="File to write.")],
    terrain_seed: Annotated[int, typer.Option(min=0, help="Seed of rough ground (--set terrain.difficulty=1).")] = 0,
    overrides: Overrides = None,
) -> None:
    """Write the robot and its ground as a model of MuJoCo."""
    from t6gps.workers.ground.ground import ground
    from t6gps.workers.physics.mjcf import to_mjcf

    configuration.check_keys(
        overrides or [], "export mjcf", EXPORT_SECTIONS, "the model has only a robot and its ground"
    )
    config = configuration.parse("{}", overrides or [], "--set")
    text = to_mjcf(config.robot, ground(config.terrain, terrain_seed, config.terrain.difficulty))
    try:
        out.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}; name a file in an existing folder") from None
    typer.echo(out)


def _episodes(
    context: typer.Context,
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Folder to write, which must not exist.")],
    run: Annotated[str, typer.Option("--run", metavar="RUN|PATTERN", help="A run, or a pattern such as 'rough-*'.")] = (
        "*"
    ),
    where: Annotated[
        str | None, typer.Option(metavar="SQL", help="Condition over `episodes` and `runs` that episodes meet.")
    ] = None,
    license_: Annotated[
        str, typer.Option("--license", metavar="SPDX", help="Licence of the data.")
    ] = exporting.LICENSE,
    root: Root = DEFAULT_ROOT,
) -> None:
    with terminal.task("exporting") as progress:
        done = exporting.export(
            str(context.info_name),
            out,
            root=root,
            run=run,
            where=where,
            license=license_,
            progress=progress,
            warn=terminal.warn,
        )
    terminal.say(f"{done.episodes} episodes, {done.steps} control steps, runs: {done.runs}, licence: {license_}")
    for loss in done.losses:
        terminal.say(f"not held: {loss}")
    typer.echo(out)


for name, form in FORMATS.items():
    export.command(name, help=f"Write episodes of training as {form.title}.")(_episodes)

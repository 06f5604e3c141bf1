"""The command that writes files for other tools: `export`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service import config as configuration
from t6gps.service.cli.options import DEFAULT_ROOT, Overrides, Root
from t6gps.storage.errors import ConfigError

EXPORT_SECTIONS = ("robot.", "terrain.")


class ExportFormat(StrEnum):
    """Formats in which the robot leaves."""

    MJCF = "mjcf"


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    for command in (export,):
        app.command()(command)


def export(
    form: Annotated[ExportFormat, typer.Argument(metavar="mjcf", help="MuJoCo's model format.")],
    out: Annotated[Path, typer.Argument(metavar="FILE.xml", help="File to write.")],
    terrain_seed: Annotated[int, typer.Option(min=0, help="Seed of rough ground (--set terrain.difficulty=1).")] = 0,
    root: Root = DEFAULT_ROOT,
    overrides: Overrides = None,
) -> None:
    """Write the robot and its ground as a model for other tools."""
    from t6gps.workers.ground.ground import ground
    from t6gps.workers.physics.mjcf import to_mjcf

    configuration.check_keys(
        overrides or [], f"export {form.value}", EXPORT_SECTIONS, "the model has only a robot and its ground"
    )
    config = configuration.parse("{}", overrides or [], "--set")
    text = to_mjcf(config.robot, ground(config.terrain, terrain_seed, config.terrain.difficulty))
    try:
        out.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}; name a file in an existing folder") from None
    typer.echo(out)

"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from t6gps.storage.errors import ConfigError
from t6gps.storage.objects import place

DEFAULT_ROOT = Path("runs")
INTERRUPTED = 130
"""The exit code of a command that Ctrl-C has ended."""


Root = Annotated[
    Path,
    typer.Option(
        "--root",
        envvar="T6GPS_ROOT",
        metavar="FOLDER|s3://BUCKET/PREFIX",
        parser=place.at,
        help="Folder that holds the runs, or an object store to read them from.",
    ),
]
Server = Annotated[
    str | None,
    typer.Option("--server", metavar="URL", envvar="T6GPS_SERVER", help="A server (t6gps serve) in place of --root."),
]
RunName = Annotated[str, typer.Argument(metavar="RUN", help="Name of a run (see `t6gps runs`).")]
JobName = Annotated[str, typer.Argument(metavar="JOB|RUN", help="Name of a job (see `t6gps jobs`), or of its run.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, e.g. robot.friction=0.7; no value is none."),
]
Publish = Annotated[
    str | None,
    typer.Option("--publish", metavar="s3://BUCKET/PREFIX", help="Copy each iteration into an object store meanwhile."),
]
Serial = Annotated[bool, typer.Option("--serial", help="Run in this process, without Ray; same data.")]
Workers = Annotated[int | None, typer.Option("--workers", help="Rollout workers (changes the speed only).")]
Autoscale = Annotated[
    str | None, typer.Option("--autoscale", metavar="MIN:MAX", help="Keep workers between, by backlog and free CPUs.")
]


def with_workers(overrides: list[str] | None, workers: int | None, autoscale: str | None = None) -> list[str]:
    """The overrides, and those that --workers and --autoscale stand for. ConfigError unless it is MIN:MAX."""
    settings = [] if workers is None else [f"run.workers={workers}"]
    if autoscale is not None:
        least, colon, most = autoscale.partition(":")
        if not (colon and least.isdecimal() and most.isdecimal()):
            raise ConfigError(f"--autoscale takes MIN:MAX, found '{autoscale}'; for example --autoscale 1:8")
        settings += [f"run.workers_min={least}", f"run.workers_max={most}"]
    return (overrides or []) + settings

"""The command that looks for what would keep a run from starting on this machine."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Annotated

import typer

from t6gps.service import checks
from t6gps.service.checks import Finding, Wanted
from t6gps.service.cli.options import DEFAULT_ROOT, Json, Root
from t6gps.service.config import RunSettings
from t6gps.service.views import terminal

COLUMNS = {"check": ("check", "{}"), "found": ("found", "{}"), "needed": ("needed", "{}"), "remedy": ("remedy", "{}")}
EXIT_STOPPED = 2


def add_to(app: typer.Typer) -> None:
    """Let the program have this command."""
    app.command()(doctor)


def doctor(
    root: Root = DEFAULT_ROOT,
    workers: Annotated[int, typer.Option(min=1, help="Workers that a run shall have.")] = RunSettings().workers,
    as_json: Json = False,
) -> None:
    """Check this machine: what a run needs, what was found, what helps. Exits with 2 where no run would start."""
    findings = checks.look(Wanted(workers, root))
    stopped = [finding.check for finding in findings if finding.stops and not finding.good]
    if as_json:
        typer.echo(json.dumps({"starts": not stopped, "checks": [_row(finding) for finding in findings]}))
    else:
        terminal.print_rows("What a run needs", [_row(finding) for finding in findings], COLUMNS)
        typer.echo(f"a run would not start: {', '.join(stopped)}" if stopped else "a run starts on this machine")
    if stopped:
        raise typer.Exit(EXIT_STOPPED)


def _row(finding: Finding) -> dict[str, str | bool]:
    return asdict(finding) | {"remedy": finding.remedy, "good": finding.good}

"""What a shell completes at TAB, without loading the commands, which takes a second.

`commands.json` beside this file says what commands and options there are and what they take; `described.py` makes it
of the commands, and `make docs` writes it. A program with those commands, which do nothing, answers by Typer's own
protocols for bash, zsh and fish. Runs and jobs are looked up when they are asked for.
"""

from __future__ import annotations

import inspect
import json
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TypeAlias, TypedDict

import typer

from t6gps.storage.errors import T6GpsError

PROGRAM, VARIABLE = "t6gps", "_T6GPS_COMPLETE"
FILE = Path(__file__).with_name("commands.json")
Values: TypeAlias = Mapping[str, str]
"""What can be written, and what each means."""


class Parameter(TypedDict):
    """A parameter of a command; without `options` it is an argument."""

    name: str
    options: list[str]
    help: str
    flag: bool
    many: bool
    takes: str | None
    """What `values` or LOOKED_UP know it by."""


class Command(TypedDict):
    """A command by its words, a group where it has no parameters but `commands` of its own."""

    help: str
    parameters: list[Parameter]
    commands: dict[str, Command]


class Described(TypedDict):
    """All commands, and what can be written for what parameters take."""

    commands: dict[str, Command]
    values: dict[str, dict[str, str]]


def asked() -> bool:
    """True where a shell has started this process for a completion."""
    return os.environ.get(VARIABLE, "").startswith("complete_")


def answer() -> None:
    """Print what the shell can offer, and exit."""
    described: Described = json.loads(FILE.read_text(encoding="utf-8"))
    program(described)(prog_name=PROGRAM)


def program(described: Described) -> typer.Typer:
    """A program with such commands, which do nothing."""
    return _group(described["commands"], described["values"])


def _group(commands: Mapping[str, Command], values: Mapping[str, Values]) -> typer.Typer:
    app = typer.Typer()
    for name, command in commands.items():
        if command["commands"]:
            app.add_typer(_group(command["commands"], values), name=name, help=command["help"])
        else:
            app.command(name, help=command["help"])(_idle([_taken(known, values) for known in command["parameters"]]))
    return app


def _idle(parameters: Iterable[inspect.Parameter]) -> Callable[..., None]:
    """A function with such parameters."""

    def idle(**_: object) -> None: ...

    idle.__signature__ = inspect.Signature(list(parameters))  # type: ignore[attr-defined]
    return idle


def _taken(known: Parameter, values: Mapping[str, Values]) -> inspect.Parameter:
    """A parameter as Typer reads it from a function."""

    def offered(context: typer.Context, incomplete: str) -> list[str | tuple[str, str]]:
        return _offered(known["takes"], values, context.params)

    kind = bool if known["flag"] else list[str] if known["many"] else str
    if known["options"]:
        default = typer.Option(
            False if known["flag"] else None, *known["options"], help=known["help"], autocompletion=offered
        )
    else:
        default = typer.Argument(None, help=known["help"], autocompletion=offered)
    return inspect.Parameter(known["name"], inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def _offered(
    takes: str | None, values: Mapping[str, Values], given: Mapping[str, object]
) -> list[str | tuple[str, str]]:
    look_up = LOOKED_UP.get(takes or "")
    if look_up is not None:
        root = given.get("root") or os.environ.get("T6GPS_ROOT") or "runs"
        far = given.get("server") or os.environ.get("T6GPS_SERVER")
        return [] if far else list(look_up(str(root)))
    return [(value, meaning) if meaning else value for value, meaning in values.get(takes or "", {}).items()]


def runs(root: str) -> list[str]:
    """Names of the runs of a folder; none of an object store, which takes longer to ask than a shell waits.

    None where the folder cannot be read, either: what is printed is offered, and no place is left for an error.
    """
    from t6gps.storage import catalog
    from t6gps.storage.objects import place

    try:
        return [] if place.is_object(Path(root)) else [run.name for run in catalog.list_runs(Path(root))]
    except (T6GpsError, OSError):
        return []


def jobs(root: str) -> list[str]:
    """Names of the user's jobs, and of the runs of a root."""
    from t6gps.service.launch import state

    known = {path.stem for path in state.folder().glob("[!.]*.json")}
    return sorted(known.union(runs(root)))


LOOKED_UP: Mapping[str, Callable[[str], list[str]]] = {
    "RUN": runs,
    "[RUN]": runs,
    "[RUN...]": runs,
    "RUN|PATTERN": runs,
    "JOB|RUN": jobs,
}
"""What is looked up in a root, by the metavar of what takes it."""

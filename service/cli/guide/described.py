"""The commands as data, for `completion.py`: what there is, what it takes, and what can be written for that.

A parameter's metavar says what it takes: `RUN` a run, `KEY=VALUE` a setting. A choice takes its members.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from enum import Enum
from typing import Literal, get_args, get_origin

import typer
import typer.core
import typer.main

from t6gps.service import config as configuration
from t6gps.service.api import asking
from t6gps.service.bench import registry
from t6gps.service.cli.guide.completion import LOOKED_UP, Command, Described, Parameter
from t6gps.service.studies import declared
from t6gps.storage.sql import views


def described(app: typer.Typer) -> Described:
    """The commands of a program with commands, and what can be written for what they take."""
    values: dict[str, dict[str, str]] = {
        "PRESET|FILE.toml": dict.fromkeys(configuration.presets(), ""),
        "KEY=VALUE": dict(_settings()),
        "STUDY": dict.fromkeys(declared.STUDIES, ""),
        "BENCHMARK": dict.fromkeys(registry.BENCHMARKS, ""),
        "TABLE": dict.fromkeys(views.asked(asking.ABOUT.columns), ""),
    }
    return {"commands": _commands(typer.main.get_command(app), values), "values": values}


def text(app: typer.Typer) -> str:
    """The same as `commands.json` holds it."""
    return json.dumps(described(app), indent=1, ensure_ascii=False) + "\n"


def _commands(group: object, values: dict[str, dict[str, str]]) -> dict[str, Command]:
    """The commands of a group, none of a command. Adds to `values` what choices take."""
    if not isinstance(group, typer.core.TyperGroup):
        return {}
    return {
        name: {
            "help": (command.help or "").strip(),
            "parameters": [_parameter(known, values) for known in command.params],
            "commands": _commands(command, values),
        }
        for name, command in group.commands.items()
    }


def _parameter(known: object, values: dict[str, dict[str, str]]) -> Parameter:
    assert isinstance(known, typer.core.TyperArgument | typer.core.TyperOption)
    takes, kind = known.metavar, known.type_descriptor.annotation
    if isinstance(kind, type) and issubclass(kind, Enum):
        takes = "|".join(str(member.value) for member in kind)
        values[takes] = dict.fromkeys(takes.split("|"), "")
    return {
        "name": known.name,
        "options": known.opts if isinstance(known, typer.core.TyperOption) else [],
        "help": known.help or "",
        "flag": kind is bool,
        "many": known.multiple or known.nargs == -1,
        "takes": takes if takes in {*values, *LOOKED_UP} else None,
    }


def _settings() -> Iterator[tuple[str, str]]:
    """Each setting with its default, or with each of its choices; a list with none, which a shell might take apart."""
    for key, field in configuration.settings():
        for value in _choices(field.annotation) or [field.get_default()]:
            plain = isinstance(value, bool | int | float | str)
            text = value if isinstance(value, str) else json.dumps(value) if plain else ""
            yield f"{key}={text}", field.description or ""


def _choices(kind: object) -> list[object]:
    """What a setting can be, where that is a few words; else nothing."""
    if kind is bool:
        return [False, True]
    if isinstance(kind, type) and issubclass(kind, Enum):
        return [member.value for member in kind]
    return list(get_args(kind)) if get_origin(kind) is Literal else []

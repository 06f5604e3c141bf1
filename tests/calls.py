"""Calls of `t6gps` in documents: their arguments, and what is wrong with them."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from itertools import pairwise

import typer.core
import typer.main

from t6gps.service import config as configuration
from t6gps.service.cli.main import app

COMMAND = typer.main.get_command(app)
assert isinstance(COMMAND, typer.core.TyperGroup)
SETTINGS = {key for key, _ in configuration.settings()}


def arguments(commands: str) -> Iterator[list[str]]:
    """Arguments of every call of `t6gps` in lines of a shell."""
    lexer = shlex.shlex(commands.replace("\n", "\n; "), posix=True, punctuation_chars=";&|")
    lexer.whitespace_split = True
    call: list[str] | None = None
    for token in lexer:
        if set(token) <= set(";&|"):
            if call:
                yield call
            call = None
        elif call is not None:
            call.append(token)
        elif token == "t6gps":
            call = []
    if call:
        yield call


def complaints(call: list[str]) -> list[str]:
    """What is wrong with a call: an unknown command, option or setting."""
    name, *rest = call
    known = getattr(COMMAND, "commands", {})
    if name.startswith("-"):
        return []
    if name not in known:
        return [f"t6gps {name}: no such command"]
    command = known[name]
    if hasattr(command, "commands"):
        if rest and rest[0] not in command.commands:
            return [f"t6gps {name} {rest[0]}: no such command"]
        if rest:
            name, command, rest = f"{name} {rest[0]}", command.commands[rest[0]], rest[1:]
    options = {option for parameter in command.params for option in parameter.opts} | {"--help"}
    words = [word.strip("[]") for word in rest]
    unknown = [
        f"t6gps {name} {word}: no such option"
        for word in words
        if word[:2] == "--" and word.split("=")[0] not in options
    ]
    keys = [key for before, key in pairwise(words) if before == "--set" and "=" in key]
    keys += [word.removeprefix("--set=") for word in words if word.startswith("--set=")]
    return unknown + [f"t6gps {name} --set {key}: no such setting" for key in keys if key.split("=")[0] not in SETTINGS]

"""Laws of examples: each command has some in its help, and each example is a call that the program takes."""

from __future__ import annotations

import re
from collections.abc import Iterator

import calls
import pytest
import typer.core
from command import t6gps

from t6gps.service.cli.guide.examples import EXAMPLES

WIDTH = 78
"""Of a line of help in a terminal of 80 columns."""


def commands(group: typer.core.TyperGroup, words: tuple[str, ...] = ()) -> Iterator[str]:
    """The words of a group and of every command in it."""
    yield " ".join(words)
    for name, command in group.commands.items():
        if isinstance(command, typer.core.TyperGroup):
            yield from commands(command, (*words, name))
        else:
            yield " ".join((*words, name))


def test_every_command_has_one_to_three_examples() -> None:
    assert sorted(EXAMPLES) == sorted(commands(calls.COMMAND))
    assert {len(examples) for examples in EXAMPLES.values()} <= {1, 2, 3}


@pytest.mark.parametrize("command", EXAMPLES)
def test_an_example_is_a_call_of_its_command(command: str) -> None:
    for example in EXAMPLES[command]:
        (call,) = calls.arguments(example)
        assert call[: len(command.split())] == command.split()
        assert not calls.complaints(call)
        taking: object = calls.COMMAND
        while isinstance(taking, typer.core.TyperGroup):
            taking = taking.commands[call.pop(0)]
        assert isinstance(taking, typer.core.TyperCommand)
        taking.make_context(taking.name, call)  # an error where it does not take them


@pytest.mark.parametrize("command", ["", "train", "token", "token create"])
def test_help_ends_with_the_examples(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    text = t6gps(*command.split(), "--help").stdout.decode()
    lines = [re.sub(r"\x1b\[[0-9;]*m", "", line).strip() for line in text.splitlines()]
    assert [line for line in lines if line][-len(EXAMPLES[command]) - 1 :] == ["Examples:", *EXAMPLES[command]]


def test_examples_fit_into_a_terminal() -> None:
    assert not [example for examples in EXAMPLES.values() for example in examples if len(example) > WIDTH]

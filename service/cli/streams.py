"""The standard streams of the command: whatever they are, it does its work and ends as if they were a terminal.

A stream that whoever started the command has closed leads nowhere. What is written after a reader has gone, as `head`
does, is dropped. A character that the locale lacks is written as its escape.
"""

from __future__ import annotations

import io
import os
import sys
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class _StandardStream(io.FileIO):
    """A standard stream as bytes, whose reader may go."""

    def write(self, data: ReadableBuffer, /) -> int:
        try:
            return super().write(data)
        except OSError as error:
            _lead_nowhere(self.fileno())  # also what is buffered, when the interpreter ends
            if not isinstance(error, BrokenPipeError):
                error.filename = ("standard input", "standard output", "standard error")[self.fileno()]
                raise
            return super().write(data)


def prepare() -> None:
    """Make the standard streams of this process safe; to be called before it opens any file."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            _lead_nowhere(number)  # else the next file that is opened would be the standard stream
    sys.stdout, sys.stderr = _writer(1, sys.stdout), _writer(2, sys.stderr)


def _lead_nowhere(number: int) -> None:
    nowhere = os.open(os.devnull, os.O_RDWR)
    if nowhere != number:
        os.dup2(nowhere, number)
        os.close(nowhere)
    os.set_inheritable(number, True)  # for the processes that this one starts


def _writer(number: int, before: TextIO | None) -> TextIO:
    stream = io.BufferedWriter(_StandardStream(number, "w", closefd=False))
    line_buffering = number == 2 or stream.isatty()
    encoding = before.encoding if before else "utf-8"
    return io.TextIOWrapper(stream, encoding, errors="backslashreplace", line_buffering=line_buffering)

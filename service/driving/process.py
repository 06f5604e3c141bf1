"""The process of a drive: robots that keep pace with the clock on the wall, and no faster.

    python -m t6gps.service.driving.process

Its standard input brings a line of its owner's with how long it may last (s) and an `Order` (`written`), and then a
`Command` in each line of JSON. Its standard output has a line for whatever is told, KIND and JSON: scene, frame, and
end with the reason. It ends with its input, so that it outlives no owner.
"""

from __future__ import annotations

import json
import os
import resource
import select
import signal
import time
from collections.abc import Callable
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import final

from t6gps.service.driving.commands import Command
from t6gps.service.driving.field import Field, Frame, Scene
from t6gps.service.driving.order import Order
from t6gps.storage.errors import T6GpsError
from t6gps.workers.physics.engine import CONTROL_STEP_S

MEMORY_BYTES_N = 2**30
"""Beside what its libraries take."""
Tell = Callable[[str, object], None]


def limit(longest_s: float) -> None:
    """Set bounds that hold even when the owner dies."""
    pages_n = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    for kind, bound in (
        (resource.RLIMIT_AS, pages_n * resource.getpagesize() + MEMORY_BYTES_N),
        (resource.RLIMIT_CPU, round(longest_s) + 60),
        (resource.RLIMIT_CORE, 0),
    ):
        least = min(most for most in (bound, *resource.getrlimit(kind)) if most != resource.RLIM_INFINITY)
        resource.setrlimit(kind, (least, least))


@final
class Lines:
    """Lines of a file descriptor, as they come."""

    def __init__(self, file: int) -> None:
        self._file, self._read = file, b""

    def next(self, wait_s: float | None) -> bytes | None:
        """The next line, None where none has come in so many seconds. EOFError where there will be none."""
        while b"\n" not in self._read:
            if not select.select([self._file], [], [], wait_s)[0]:
                return None
            piece = os.read(self._file, 2**16)
            if not piece:
                raise EOFError
            self._read += piece
        line, _, self._read = self._read.partition(b"\n")
        return line


def written(longest_s: float, order: Order) -> bytes:
    """The line with which a drive begins: JSON."""
    return json.dumps({"longest_s": longest_s, "order": order.to_json()}).encode() + b"\n"


def drive(field: Field, lines: Lines, tell: Tell) -> None:
    """Let robots move as lines command, and tell what is seen. What comes during a step acts after it."""
    _tell(tell, field.scene(), field.frame())
    due_s, asked, is_other = time.monotonic() + CONTROL_STEP_S, None, False
    while True:
        wait_s = None if field.paused and asked is None else max(due_s - time.monotonic(), 0.0)
        line = lines.next(wait_s)
        if line is not None:
            command = Command.model_validate_json(line)
            if asked is not None and asked.push is not None and command.push is not None:
                is_other |= field.obey(asked)  # each push acts
                asked = None
            asked = command if asked is None else command.after(asked)
            continue
        if asked is not None:
            is_other |= field.obey(asked)
        field.step()
        _tell(tell, field.scene() if is_other else None, field.frame())
        asked, is_other = None, False
        due_s = max(due_s + CONTROL_STEP_S, time.monotonic())  # time that was lost stays lost


def _tell(tell: Tell, scene: Scene | None, frame: Frame) -> None:
    if scene is not None:
        tell("scene", asdict(scene))
    tell("frame", asdict(frame))


def main() -> None:
    """Drive what the standard input says."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner decides what Ctrl-C ends
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # nobody is left who could be told
    told = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a library prints is no frame

    def tell(kind: str, data: object) -> None:
        told.write(f"{kind} {json.dumps(data)}\n".encode())
        told.flush()

    lines = Lines(0)
    try:
        first = lines.next(None)
        assert first is not None
        given = json.loads(first)
        limit(given["longest_s"])
        with closing(Field(Order.of_json(given["order"]))) as field:
            drive(field, lines, tell)
    except EOFError:
        return  # nobody commands any more
    except (T6GpsError, MemoryError) as error:
        tell("end", str(error) or f"the simulation needs more than {MEMORY_BYTES_N >> 20} MiB; begin a smaller one")


if __name__ == "__main__":
    main()

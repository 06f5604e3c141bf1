"""The command `t6gps`: in this process, or in one of its own where the test is about the process."""

from __future__ import annotations

import io
import signal
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from t6gps.service.cli import main


@dataclass(frozen=True)
class Done:
    """A command that has ended: its exit code and what it wrote."""

    code: int
    stdout: bytes
    stderr: str


def t6gps(*arguments: str | Path, code: int = 0) -> Done:
    """Run a command in this process, and see that it ends with `code`."""
    out, error = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    ended = 0
    with redirect_stdout(out), redirect_stderr(error):
        try:
            main.main([str(argument) for argument in arguments])
        except SystemExit as exit_:
            ended = int(exit_.code or 0)
    done = Done(ended, out.buffer.getvalue(), error.buffer.getvalue().decode())  # type: ignore[attr-defined]
    assert done.code == code, done.stderr + done.stdout.decode()
    return done


def started(*arguments: str | Path) -> subprocess.Popen[bytes]:
    """Start a command in a process of its own that heeds Ctrl-C, which a shell's background jobs do not."""
    return subprocess.Popen(
        [sys.executable, "-m", "t6gps", *map(str, arguments)],
        stderr=subprocess.PIPE,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
    )

"""Laws of the standard streams: a reader that goes, a closed stream and a poor locale stop no command."""

from __future__ import annotations

import fcntl
import json
import os
import pty
import re
import struct
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from t6gps.service.config import load
from t6gps.storage import catalog

pytestmark = pytest.mark.slow  # each starts processes
COMMANDS = {
    "help": ["--help"],
    "runs": ["runs"],
    "show": ["show", "empty"],
    "table": ["query", "empty", "SELECT chr(233) AS letter"],
    "csv": ["query", "empty", "SELECT range FROM range(100000)", "--format=csv"],
}


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a run that holds no data yet."""
    folder = tmp_path_factory.mktemp("runs")
    catalog.create(folder, "empty", load("flat-quick").to_json())
    return folder


def shell(redirection: str, root: Path, arguments: list[str], **environment: str) -> subprocess.CompletedProcess[bytes]:
    """Run a command under a redirection of the shell."""
    return subprocess.run(
        ["sh", "-c", f'"$@" {redirection}', "sh", sys.executable, "-m", "t6gps", *arguments],
        capture_output=True,
        env={**os.environ, "T6GPS_ROOT": str(root), **environment},
        check=False,
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_a_reader_that_has_gone_ends_a_command_in_quiet(root: Path, command: str) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-m", "t6gps", *COMMANDS[command]],
        stdout=writer,
        stderr=subprocess.PIPE,
        env={**os.environ, "T6GPS_ROOT": str(root)},
        check=False,
    )
    os.close(writer)
    assert (done.returncode, done.stderr) == (0, b"")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_closed_output_stops_no_command(root: Path, command: str) -> None:
    done = shell(">&- <&-", root, COMMANDS[command])
    assert (done.returncode, done.stderr) == (0, b"")


def test_a_closed_error_stream_changes_neither_result_nor_exit_code(root: Path) -> None:
    assert shell("2>&-", root, ["query", "empty", "SELECT 1 AS n", "--format=csv"]).stdout == b'"n"\n1\n'
    refused = shell("2>&-", root, ["query", "empty", "SELEC"])
    assert (refused.returncode, refused.stdout) == (2, b"")


def test_processes_that_a_command_starts_have_standard_streams_too() -> None:
    program = "from t6gps.service.cli import streams; streams.prepare(); import os; os.execlp('echo', 'echo')"
    closed = ["sh", "-c", '"$@" >&-', "sh", sys.executable, "-c", program]
    assert subprocess.run(closed, check=False, capture_output=True).stderr == b""


def test_an_output_that_is_full_is_told_of(root: Path) -> None:
    for command in ("runs", "csv"):
        done = shell(">/dev/full", root, COMMANDS[command])
        assert done.returncode == 2
        assert done.stderr.startswith(b"error: standard output: No space left on device")
        assert b"Traceback" not in done.stderr


@pytest.mark.parametrize(
    "environment",
    [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}],
    ids=["ascii", "C"],
)
def test_a_poor_locale_gets_escapes_and_plain_lines(root: Path, environment: dict[str, str]) -> None:
    done = shell("", root, COMMANDS["table"], **environment)
    assert (done.returncode, done.stderr) == (0, b"")
    lines = done.stdout.decode("ascii").splitlines()
    assert [len(line) for line in lines] == [len(lines[0])] * len(lines)
    assert "\\xe9" in lines[-2]
    as_json = shell("", root, [*COMMANDS["table"], "--format=json"], **environment)
    assert json.loads(as_json.stdout) == [{"letter": "é"}]
    refused = shell("", root, ["query", "empty", "SELECT $$\\$$::INT, chr(233)::INT"], **environment)
    assert refused.returncode == 2
    assert b"Conversion Error" in refused.stderr and b"Traceback" not in refused.stderr


@pytest.mark.parametrize("columns_n", [80, 132])
def test_a_table_is_as_wide_as_the_terminal_and_says_what_it_leaves_out(root: Path, columns_n: int) -> None:
    ours, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns_n, 0, 0))
    columns = ", ".join(f"range + {n} AS c{n}, range(36) AS v{n}" for n in range(20))
    known = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    process = subprocess.Popen(
        [sys.executable, "-m", "t6gps", "query", "empty", f"SELECT {columns} FROM range(1000)", "--root", str(root)],
        stdout=terminal,
        env=known | {"TERM": "xterm", "PYTHONIOENCODING": "utf-8"},
    )
    os.close(terminal)
    printed = b""
    try:
        while chunk := os.read(ours, 65536):
            printed += chunk
    except OSError:  # the terminal's other end is closed
        pass
    finally:
        os.close(ours)
    assert process.wait() == 0
    lines = re.sub(r"\x1b\[[0-9;]*m", "", printed.decode()).splitlines()
    assert max(map(len, lines)) <= columns_n
    shown_n = lines[1].count("c") + lines[1].count("v")
    assert 2 <= shown_n < 40
    assert " ".join(map(str.strip, lines[3 + 40 + 1 :])) == (
        f"40 of 1000 rows, {shown_n} of 40 columns shown, long values shortened; --format csv gives all"
    )

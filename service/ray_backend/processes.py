"""Looking at processes of this machine from outside, also when they hang and answer nothing.

A worker registers `dump_stacks_on_signal`; then its stacks can be had even while C code holds the interpreter's lock.
"""

from __future__ import annotations

import faulthandler
import os
import signal
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

STACKS_S = 0.3
LOG_TAIL_BYTES = 8000
FAULT = "Fatal Python error"


@dataclass(frozen=True)
class Process:
    """A process of some machine. `started` tells it from a later one with the same number."""

    pid: int
    started: int
    stacks: int
    """File descriptor, in that process, of the memory that its stacks are written to."""


def dump_stacks_on_signal() -> Process:
    """Let SIGUSR1 write the stacks of this process to a file in memory; this process, for `stacks` and `kill`."""
    descriptor = os.memfd_create("stacks")
    faulthandler.register(signal.SIGUSR1, file=descriptor, all_threads=True)
    return Process(os.getpid(), _stat(os.getpid())[1], descriptor)


def stopped(process: Process) -> bool:
    """True when somebody has stopped a process of this machine (SIGSTOP)."""
    return _state(process) == "T"


def stacks(process: Process) -> str:
    """Stacks of a process of this machine, or what can be said in their place."""
    state = _state(process)
    if state in ("", "Z"):
        return "the process has ended"
    if stopped(process):
        return "the process is stopped (SIGSTOP): it has no stack to show"
    file = Path(f"/proc/{process.pid}/fd/{process.stacks}")
    try:
        os.kill(process.pid, signal.SIGUSR1)
        deadline, text, before = time.monotonic() + STACKS_S, b"", None
        while time.monotonic() < deadline and (not text or text != before):
            time.sleep(0.01)
            before, text = text, file.read_bytes()
    except OSError as error:
        return f"its stacks could not be read: {error}"
    return text.decode(errors="replace") or f"no stacks within {STACKS_S} s; process state {state}"


def kill(process: Process) -> None:
    """End a process of this machine at once, also a stopped one; one that has ended already is left alone."""
    with suppress(ProcessLookupError):
        if _state(process):
            os.kill(process.pid, signal.SIGKILL)


def end(pids: Iterable[int]) -> None:
    """End processes of this machine at once; those that have ended already are left alone."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def log_tail(folder: Path, pid: int) -> str:
    """The end of what a process of this machine wrote to its logs in `folder`."""
    text = ""
    for path in sorted(folder.glob(f"worker-*-{pid}.*")):
        content = path.read_bytes()[-LOG_TAIL_BYTES:]
        text += content.decode(errors="replace")
    return text


def descendants(pid: int) -> list[int]:
    """Process ids of a process's children on this machine, of their children, and so on."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*"):
        with suppress(FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
            parents[int(path.name)] = int(_fields(int(path.name))[1])
    family = [pid]
    for parent in family:  # it grows
        family += [child for child, whose in parents.items() if whose == parent]
    return family[1:]


def command(pid: int) -> str:
    """The command line of a process, or the title that it gave itself; empty when it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    except (FileNotFoundError, ProcessLookupError):
        return ""


def cpu_s(pid: int) -> float:
    """Processor time of a process (s), of all its threads and without its children; 0 when it has ended."""
    try:
        fields = _fields(pid)
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def peak_mb(pid: int) -> float:
    """Largest resident memory of a process (MB), shared memory and mapped files included; 0 when it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    _, _, rest = status.partition("VmHWM:")
    return int(rest.split()[0]) / 1024 if rest else 0.0


def fault_in(log: str) -> bool:
    """True when a process said in its log how it failed in C; Ray has every process do so."""
    return FAULT in log


def _state(process: Process) -> str:
    """State letter of a process of this machine, empty when it is no more."""
    try:
        state, started = _stat(process.pid)
    except (FileNotFoundError, ProcessLookupError):
        return ""
    return state if started == process.started else ""


def _stat(pid: int) -> tuple[str, int]:
    """State letter and start time of a process. FileNotFoundError or ProcessLookupError when there is none."""
    fields = _fields(pid)
    return fields[0], int(fields[19])


def _fields(pid: int) -> list[str]:
    """What follows the name in /proc/PID/stat: state, parent, ..."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()

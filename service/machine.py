"""What this machine has for a Ray of one's own: a folder for its sockets, memory to share, descriptors.

Where the usual place does not do, another one is taken: nobody needs to know.
"""

from __future__ import annotations

import os
import re
import resource
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

MEBIBYTE = 2**20
SOCKET_PATH_BYTES = 107
"""The kernel's limit for the path of a socket."""
SOCKET_BELOW = "/session_2026-01-01_00-00-00_000000_1234567/sockets/plasma_store"
"""Where Ray puts its sockets below its folder."""
RAY_SESSION = re.compile(r"session_\d{4}-\d{2}-\d{2}_\d{2}-\d{2}-\d{2}_\d+_\d+")
"""Name of the folder of one start of Ray, which somebody removes some time after its end."""
TEMPORARY_BYTES = 64 * MEBIBYTE
"""For the logs and sockets of a run."""
STORE_BYTES, LEAST_STORE_BYTES = 2048 * MEBIBYTE, 128 * MEBIBYTE
"""What Ray's object store shall have, and what a run needs: 32 long episodes."""
SHARED = Path("/dev/shm")
DESCRIPTORS_N, DESCRIPTORS_PER_WORKER_N = 150, 10
"""Open files and connections of the process that has most of them, Ray's node manager: 82 with two workers, 121 with
eight."""


@dataclass(frozen=True)
class Store:
    """Where Ray's object store lies, and its size."""

    folder: Path
    nbytes: int


def temporary_folders() -> list[Path]:
    """Where Ray may keep sockets and logs, the best first: the folders that the environment names, then the usual."""
    named = [Path(os.environ[name]) for name in ("RAY_TMPDIR", "TMPDIR") if os.environ.get(name)]
    places = [*(path.absolute() for path in named), Path("/tmp"), Path("/var/tmp"), SHARED]
    return [place / name for place in places for name in ("ray", f"ray-{os.getuid()}")]


def temporary_folder() -> Path | None:
    """The first of `temporary_folders` that can be used, made when it is missing; None when there is none."""
    return next((folder for folder in temporary_folders() if not fault_of(folder)), None)


def fault_of(folder: Path) -> str:
    """Why Ray cannot keep sockets and logs in a folder, empty when it can; the folder is made when it is missing."""
    if len(os.fsencode(folder)) + len(SOCKET_BELOW) > SOCKET_PATH_BYTES:
        return f"{folder} is {len(os.fsencode(folder))} bytes long"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        return f"{folder}: {error.strerror}"
    if free_bytes(folder) < TEMPORARY_BYTES:
        return f"{folder} has {free_bytes(folder) // MEBIBYTE} MiB"
    return ""


def object_store(temporary: Path) -> Store:
    """Shared memory where there is enough, else a file in the temporary folder, else the larger of the two."""
    places = [SHARED, temporary] if os.access(SHARED, os.W_OK | os.X_OK) else [temporary]
    most = min(STORE_BYTES, memory_bytes() // 3)
    stores = [Store(place, min(most, free_bytes(place) * 4 // 5)) for place in places]
    return next((store for store in stores if store.nbytes == most), max(stores, key=lambda store: store.nbytes))


def free_bytes(folder: Path) -> int:
    """Bytes that this user may still write in a folder's file system."""
    system = os.statvfs(folder)
    return system.f_bavail * system.f_frsize


def memory_bytes() -> int:
    """Memory that the processes of this machine, or of its container, may have."""
    physical = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for limit in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        with suppress(OSError, ValueError):  # there is no such limit, or it is "max"
            physical = min(physical, int(Path(limit).read_text()))
    return physical


def available_bytes() -> int:
    """Memory that nobody uses at present."""
    _, _, rest = Path("/proc/meminfo").read_text().partition("MemAvailable:")
    return int(rest.split()[0]) * 1024


def descriptors_needed_n(workers: int) -> int:
    """Open files that a process of the run may need."""
    return DESCRIPTORS_N + DESCRIPTORS_PER_WORKER_N * workers


@contextmanager
def all_descriptors() -> Iterator[None]:
    """Let this process and those that it starts open as many files as they may ever; as before at the end."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))

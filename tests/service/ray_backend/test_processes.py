"""Laws of the processes that a run starts: they listen to this machine alone, are replaced, and end with the run."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from t6gps.service.steering import requests
from t6gps.service.steering import status as statuses
from t6gps.storage import catalog
from t6gps.storage.errors import RunError

TRAIN = [
    sys.executable, "-m", "t6gps", "train", "flat-quick", "--run", "watched", "--workers", "1",
    "--set=run.episodes=200", "--set=run.iterations=1",
]  # fmt: skip
LISTENING, LOOPBACK = "0A", ("0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000")


def descendants(root: int) -> dict[int, str]:
    """Command lines of a process and all that it started, by process id."""
    parents, commands = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            stat = (folder / "stat").read_text()
            commands[int(folder.name)] = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode()
        except OSError:
            continue  # it has ended meanwhile
        parents[int(folder.name)] = int(stat.rpartition(")")[2].split()[1])
    found = {root}
    while more := {pid for pid, parent in parents.items() if parent in found} - found:
        found |= more
    return {pid: commands[pid] for pid in found if pid in commands}


def listeners(pids: dict[int, str]) -> set[str]:
    """Addresses (hexadecimal) on which the processes listen."""
    sockets = set()
    for pid in pids:
        for entry in Path(f"/proc/{pid}/fd").glob("*"):
            try:
                sockets.add(str(entry.readlink()))
            except OSError:
                continue
    addresses = set()
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[3] == LISTENING and f"socket:[{fields[9]}]" in sockets:
                addresses.add(fields[1].partition(":")[0])
    return addresses


@pytest.mark.slow
def test_t18_a_run_listens_on_loopback_outlives_a_worker_and_leaves_nothing_behind_when_it_is_stopped(
    tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    command = [*TRAIN, "--root", str(tmp_path)]
    started = subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True)
    run = catalog.Run(tmp_path / "watched")

    def spooled() -> int:
        assert started.poll() is None
        return len(list(tmp_path.glob("watched/spool/*/episode-*.arrow")))

    try:
        wait_until(lambda: spooled() >= 2, 240)
        family = descendants(started.pid)
        assert listeners(family)
        assert listeners(family) <= set(LOOPBACK)
        os.kill(statuses.status(run)["workers"][0]["pid"], signal.SIGKILL)
        before = spooled()
        wait_until(lambda: spooled() >= before + 5, 240)
        assert statuses.status(run)["processes"]["crashed"] == 1
        family = descendants(started.pid)
        for _ in range(2):  # the second stop does nothing
            started.send_signal(signal.SIGTERM)
        _, message = started.communicate(timeout=240)
    finally:
        started.kill()
    assert started.returncode == 130, message
    assert b"--resume" in message
    assert b"Traceback" not in message
    wait_until(lambda: not any(Path(f"/proc/{pid}").exists() for pid in family), 240)
    assert statuses.status(run)["state"] == "STOPPED"
    with pytest.raises(RunError, match=r"not running \(STOPPED.*--resume"):
        requests.scale(run, 2)
    assert not run.request.exists()

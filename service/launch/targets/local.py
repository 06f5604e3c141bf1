"""Jobs on this machine: processes in the background that survive the terminal they were started from."""

from __future__ import annotations

import os
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from t6gps.service.launch.folder import Folder, Planned
from t6gps.service.launch.job import Job, JobState, outcome
from t6gps.service.launch.targets.visible import VisibleLauncher, check_publishing
from t6gps.service.ray_backend import processes
from t6gps.storage.errors import RunError


class LocalLauncher(VisibleLauncher):
    """The launcher of this machine. A job's number is HOST:PID:START, so that no later process is taken for it."""

    def check(self, planned: Sequence[Planned]) -> None:
        check_publishing(planned)  # the run says what else is wrong

    def render(self, planned: Sequence[Planned]) -> str:
        folders = [job.folder for job in planned]
        return "\n".join(f"{shlex.join(_call(folder))} >> {shlex.quote(str(folder.log))} 2>&1 &" for folder in folders)

    def submit(self, planned: Sequence[Planned]) -> list[str]:
        return [_started(job.folder) for job in planned]

    def state(self, job: Job) -> tuple[JobState, str]:
        pid = _pid(job)
        return (JobState.RUNNING, f"process {pid}") if pid is not None else outcome(job.folder)

    def stop(self, job: Job) -> None:
        pid = _pid(job)
        if pid is not None:
            with suppress(ProcessLookupError):  # it has ended just now
                os.kill(pid, signal.SIGTERM)

    def cancel(self, job: Job) -> None:
        pid = _pid(job)
        if pid is not None:
            processes.end([pid, *processes.descendants(pid)])


def _call(folder: Folder) -> list[str]:
    return ["bash", str(folder.script), str(folder.path)]


def _started(folder: Folder) -> str:
    """Start a job in a session of its own, which no terminal ends; its number."""
    programs = str(Path(sys.executable).parent)
    try:
        with folder.log.open("ab") as log:
            process = subprocess.Popen(
                _call(folder),
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=folder.root,
                env=os.environ | {"PATH": f"{programs}{os.pathsep}{os.environ.get('PATH', os.defpath)}"},
                start_new_session=True,
            )
    except FileNotFoundError as error:
        raise RunError(f"cannot start a job on this machine: no {error.filename}; install bash") from None
    threading.Thread(target=process.wait, daemon=True).start()  # a server that lives longer leaves no zombie
    return f"{socket.gethostname()}:{process.pid}:{processes.started(process.pid)}"


def _pid(job: Job) -> int | None:
    """The process of a job, None when it has ended. RunError for a job of another machine."""
    host, pid, started = job.native_id.rsplit(":", 2)
    if host != socket.gethostname():
        raise RunError(f"job {job.name} runs on {host}, and this is {socket.gethostname()}; ask there")
    return int(pid) if processes.started(int(pid)) == int(started) else None

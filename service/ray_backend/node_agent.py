"""Looking at a worker's process from outside, and ending it: on this node directly, on another through an actor there.

Ray cannot show the stacks of a process that hangs, nor end one that is stopped.
"""

from __future__ import annotations

from pathlib import Path

from t6gps.service.pool.messages import Remains
from t6gps.service.ray_backend import private, processes
from t6gps.service.ray_backend.processes import Process


class NodeAgentActor:
    """Looks at the workers of its node, and ends them."""

    def __init__(self) -> None:
        self._logs = private.logs_folder()

    def examine(self, process: Process, died: bool) -> Remains:
        return remains(process, self._logs, died)

    def kill(self, process: Process) -> None:
        processes.kill(process)


def remains(process: Process, logs: Path, died: bool) -> Remains:
    """What is left of a process of this machine, which has died or does not get anywhere.

    It is not the episode's fault when somebody stopped the worker, or when the worker has died without a word: one that
    fails by itself leaves a traceback in its log, also after a fault in C.
    """
    log = processes.log_tail(logs, process.pid)
    blameless = not processes.fault_in(log) if died else processes.stopped(process)
    return Remains(processes.stacks(process), log, blameless)

"""Looking at a worker's process from outside, and ending it: on this node directly, on another through an actor there.

Ray cannot show the stacks of a process that hangs, nor end one that is stopped.
"""

from __future__ import annotations

from pathlib import Path

from t6gps.service import logs
from t6gps.service.logs import Speaker
from t6gps.service.pool.messages import PostMortem
from t6gps.service.ray_backend import private, processes
from t6gps.service.ray_backend.processes import Process


class NodeAgentActor:
    """Looks at the workers of its node, and ends them."""

    def __init__(self, speaker: Speaker) -> None:
        logs.begin(speaker)
        self._logs = private.logs_folder()

    def examine(self, process: Process, died: bool) -> PostMortem:
        return post_mortem(process, self._logs, died)

    def kill(self, process: Process) -> None:
        processes.kill(process)


def post_mortem(process: Process, logs: Path, died: bool) -> PostMortem:
    """What is left of a process of this machine, which has died or does not get anywhere.

    It is not the episode's fault when somebody stopped the worker, or when the worker has died without a word: one that
    fails by itself leaves a traceback in its log, also after a fault in C.
    """
    log = processes.log_tail(logs, process.pid)
    at_fault = processes.fault_in(log) if died else not processes.stopped(process)
    return PostMortem(processes.stacks(process), log, at_fault)

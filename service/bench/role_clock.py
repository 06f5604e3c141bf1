"""Processor time by role: of this process, which supervises and commits, and of those that Ray started for it."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager

from t6gps.service.ray_backend import processes

TITLES = {
    "ray::WorkerActor": "worker",
    "ray::LearnerActor": "learner",
    "ray::PolicyServerActor": "policy_server",
}
"""How the command lines of actors begin; every other process below this one is Ray's own."""
ROLES = ("worker", "supervisor", "committer", "learner", "policy_server", "ray")


class ThreadClock:
    """Counts processor seconds of this thread inside of `with`; `start` begins without an end.

    spent_s   until the last end
    """

    def __init__(self) -> None:
        self.spent_s, self._begin_s = 0.0, 0.0

    def start(self) -> None:
        """Count from now on."""
        self._begin_s = time.thread_time()

    def so_far_s(self) -> float:
        """What is counted until now, where it has begun and not ended."""
        return self.spent_s + time.thread_time() - self._begin_s

    def __enter__(self) -> None:
        self.start()

    def __exit__(self, *_: object) -> None:
        self.spent_s = self.so_far_s()


class RoleClock:
    """Counts processor seconds from `start` on. What this process spends outside of `of` is the supervisor's."""

    def __init__(self) -> None:
        self._own_s: dict[str, float] = {}
        self._before_s: dict[int, float] = {}
        self._driver_s = 0.0

    def start(self) -> None:
        """Forget what was spent until now."""
        self._own_s.clear()
        self._before_s = {pid: processes.cpu_s(pid) for pid in processes.descendants(os.getpid())}
        self._driver_s = time.process_time()

    @contextmanager
    def of(self, role: str) -> Iterator[None]:
        """What this thread spends inside belongs to `role`."""
        begin_s = time.thread_time()
        yield
        self._own_s[role] = self._own_s.get(role, 0.0) + time.thread_time() - begin_s

    def spent_s(self) -> dict[str, float]:
        """Processor seconds by ROLES since `start`."""
        spent = dict.fromkeys(ROLES, 0.0) | self._own_s
        spent["supervisor"] = time.process_time() - self._driver_s - sum(self._own_s.values())
        for pid in processes.descendants(os.getpid()):
            title = processes.command(pid).partition(".")[0]
            spent[TITLES.get(title, "ray")] += processes.cpu_s(pid) - self._before_s.get(pid, 0.0)
        return spent

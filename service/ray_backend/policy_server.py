"""The policy server: an actor from which workers pull a policy by its version, and the supervisor's side of it.

Policies are pulled, never pushed: a worker asks when a plan names a newer version than it has. Whoever asks has a
deadline, shorter than an episode's, so that a server that stalls is missed before a worker is taken for hung.

The supervisor never waits here: it asks whether the server has the newest policy, and looks after the pool meanwhile.
"""

from __future__ import annotations

import logging
import time
from concurrent.futures import Future, wait
from typing import NamedTuple

import ray

from t6gps.service import logs
from t6gps.service.logs import Role, Speaker
from t6gps.service.pool.deadlines import Timings
from t6gps.service.ray_backend import private, processes
from t6gps.service.ray_backend.cluster import Actor, start_actor
from t6gps.service.ray_backend.deaths import Deaths
from t6gps.service.ray_backend.processes import Process
from t6gps.storage.errors import RunError
from t6gps.storage.records import PolicySnapshot

VERSIONS_HELD_N = 2
"""In a pipelined run workers still act with the version before the newest."""
_log = logging.getLogger(__name__)


class PolicyServerActor:
    """Holds the newest policies for whoever asks."""

    def __init__(self, speaker: Speaker) -> None:
        logs.begin(speaker)
        self._process = processes.dump_stacks_on_signal()
        self._held: dict[int, PolicySnapshot] = {}

    def hold(self, snapshot: PolicySnapshot) -> None:
        """Take a policy, and forget all but the newest."""
        self._held = newest(self._held | {snapshot.version: snapshot})

    def pull(self, version: int) -> PolicySnapshot | None:
        """The policy of that version, None when it is not held."""
        return self._held.get(version)

    def ping(self) -> Process:
        """A sign of life: the server's process."""
        return self._process


def newest(held: dict[int, PolicySnapshot]) -> dict[int, PolicySnapshot]:
    """The last policies of these."""
    return {version: held[version] for version in sorted(held)[-VERSIONS_HELD_N:]}


class PolicySource(NamedTuple):
    """Where a worker pulls: the server's actor, and how many there were before it."""

    actor: Actor
    number: int


class PolicyServer:
    """Keeps a policy server at work on the supervisor's node, and replaces one that dies or stalls from its own copy.

    source    where workers pull from now on
    process   the server's, None while it starts
    """

    def __init__(self, node: str, timings: Timings) -> None:
        self._node, self._timings = node, timings
        self._held: dict[int, PolicySnapshot] = {}
        self._started_n = 0
        self._deaths, self._logs = Deaths("the policy server"), private.logs_folder()
        self._start()

    def _start(self) -> None:
        self.source = PolicySource(
            start_actor(PolicyServerActor, logs.other(Role.POLICY_SERVER), where=self._node), self._started_n
        )
        self.process: Process | None = None
        self._started_n += 1
        for version in sorted(self._held):
            self.source.actor.hold.remote(self._held[version])
        self._ask_for_life()

    def _ask_for_life(self) -> None:
        """The answer comes after the server has taken every policy that it was given before."""
        self._pong: Future[Process] = self.source.actor.ping.remote().future()
        self._pinged_s = time.monotonic()

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Give the server the newest policy, and keep a copy in case the server dies; see `has_the_newest`.

        Nothing is done for a policy that is held. RunError for one that is older than those.
        """
        if snapshot.version in self._held:
            return
        latest = max(self._held, default=snapshot.version)
        if snapshot.version < latest:
            raise RunError(f"policy versions only grow: version {latest} is published, found {snapshot.version}")
        self._held = newest(self._held | {snapshot.version: snapshot})
        self.source.actor.hold.remote(snapshot)
        self._ask_for_life()

    def has_the_newest(self, wait_s: float) -> bool:
        """True when the server has every policy that was published; waits up to `wait_s` for that."""
        wait([self._pong], wait_s)
        return self._pong.done() and self._pong.exception() is None

    def watch(self) -> None:
        """Replace a server that has died or gives no sign of life. RunError when that does not help."""
        silent_s = time.monotonic() - self._pinged_s
        if not self._pong.done():
            if silent_s > self._patience_s:
                self._replace("does not answer")
        elif (error := self._pong.exception()) is not None:
            self._replace(f"has died: {' '.join(str(error).split())}")
        else:
            self.process = self._pong.result()
            if silent_s > self._timings.ping_s:
                self._ask_for_life()

    def missed(self, number: int) -> None:
        """A worker got no answer from the server of that number."""
        if number == self.source.number:
            self._replace("does not answer a worker")

    @property
    def _patience_s(self) -> float:
        """How long an answer may take."""
        return self._timings.policy_start_s if self.process is None else self._timings.policy_answer_s

    def _replace(self, why: str) -> None:
        log = "" if self.process is None else processes.log_tail(self._logs, self.process.pid)
        last_words = logs.said(log.strip().rpartition("\n")[2])
        self._deaths.add(f"it {why}" + (f" ({last_words})" if last_words else ""))
        _log.warning("the policy server %s; another one takes its place", why)
        ray.kill(self.source.actor)
        if self.process is not None:
            processes.kill(self.process)  # a stopped process does not hear Ray
        self._start()

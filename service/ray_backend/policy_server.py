"""The weights: a holder, from which workers pull a policy by its version, and the supervisor's copy of what it holds.

The holder answers on a port of its own, in the one call of its actor, which never ends: Ray looks a hundred times a
second for signals in an actor that waits for calls, and that is a hundredth of a core.
"""

from __future__ import annotations

import logging
import secrets
import socket
import time
from contextlib import suppress
from threading import Thread
from typing import Any

import ray

from t6gps.service.ray_backend import channel, processes
from t6gps.service.ray_backend.channel import Address
from t6gps.service.ray_backend.cluster import start_actor
from t6gps.service.ray_backend.processes import Process
from t6gps.storage.errors import RunError
from t6gps.storage.records import PolicySnapshot

VERSIONS_HELD_N = 2
ANSWER_DEADLINE_S = 4.0
"""How long whoever asks waits in silence. An episode has more time than that: a worker that asks is not to blame."""
START_S = 60.0
"""So long may the holder's process take to start."""
NO_ANSWER = (EOFError, OSError)
"""What asking a holder raises that is gone or does not answer."""
_log = logging.getLogger(__name__)


class HolderActor:
    """Holds the newest policies for whoever asks."""

    def __init__(self, host: str) -> None:
        self._server, self._secret = channel.listen(host), secrets.token_bytes(32)
        self._held: dict[int, PolicySnapshot] = {}

    def whereabouts(self) -> tuple[Address, Process]:
        """Where it answers, and its process."""
        host, port = self._server.getsockname()[:2]
        return Address(host, port, 0, self._secret), processes.dump_stacks_on_signal()

    def hold(self) -> None:
        """Answer until the process is ended, each in a thread of its own: nobody waits for one that stalls."""
        while True:
            line, _ = self._server.accept()
            Thread(target=self._answer, args=(line,), daemon=True).start()

    def _answer(self, line: socket.socket) -> None:
        with line, suppress(*NO_ANSWER):
            line.settimeout(ANSWER_DEADLINE_S)
            if not channel.introduced(line, self._secret):
                return
            asked, _ = channel.receive(line)
            if isinstance(asked, PolicySnapshot):
                self._held = newest(self._held | {asked.version: asked})
                channel.send(line, None)
            else:
                channel.send(line, self._held.get(asked))


def newest(held: dict[int, PolicySnapshot]) -> dict[int, PolicySnapshot]:
    """The last policies of these."""
    return {version: held[version] for version in sorted(held)[-VERSIONS_HELD_N:]}


def pull(holder: Address, version: int) -> PolicySnapshot | None:
    """The policy of that version, None when the holder has it not. EOFError or OSError when it does not answer."""
    found: PolicySnapshot | None = _asked(holder, version)
    return found


def _asked(holder: Address, asked: int | PolicySnapshot) -> Any:
    with channel.connect(holder, ANSWER_DEADLINE_S) as line:
        channel.send(line, asked)
        return channel.receive(line)[0]


class Weights:
    """The supervisor's side: the newest policies, and a holder on its node, which is replaced when it is gone.

    host, node   this node by its address, and in Ray's words

    holder       where workers pull, None while it starts
    process      the holder's, None while it starts
    """

    def __init__(self, host: str, node: str) -> None:
        self.holder: Address | None = None
        self.process: Process | None = None
        self._host, self._node = host, node
        self._held: dict[int, PolicySnapshot] = {}
        self._start()

    def _start(self) -> None:
        self._actor = start_actor(HolderActor, self._host, where=self._node)
        self._whereabouts, self._at_work = self._actor.whereabouts.remote(), self._actor.hold.remote()
        self.holder, self.process, self._started_s = None, None, time.monotonic()

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Give the holder the newest policy, and keep it in case the holder dies.

        Nothing is done for a policy that is held. RunError for one that is older than those.
        """
        if snapshot.version in self._held:
            return
        latest = max(self._held, default=snapshot.version)
        if snapshot.version < latest:
            raise RunError(f"policy versions only grow: version {latest} is published, found {snapshot.version}")
        self._held = newest(self._held | {snapshot.version: snapshot})
        if self.holder is None:
            self._meet(START_S)
        else:
            self._give([snapshot], self.holder)

    def watch(self) -> None:
        """Replace a holder that has died; give one that has started what is kept."""
        if ray.wait([self._at_work], timeout=0)[0] or (
            self.holder is None and time.monotonic() - self._started_s > START_S
        ):
            self.replace("has died")
        elif self.holder is None:
            self._meet(0.0)

    def replace(self, why: str) -> None:
        """Start another holder in the place of this one."""
        _log.warning("the holder of the weights %s; another one takes its place", why)
        ray.kill(self._actor)
        if self.process is not None:
            processes.kill(self.process)  # a stopped process does not hear Ray
        self._start()

    def _meet(self, wait_s: float) -> None:
        """Wait for the holder to start."""
        if ray.wait([self._whereabouts], timeout=wait_s)[0]:
            with suppress(ray.exceptions.RayError):  # it died at its start: `watch` sees it
                self.holder, self.process = ray.get(self._whereabouts)
                self._give(list(self._held.values()), self.holder)

    def _give(self, snapshots: list[PolicySnapshot], holder: Address) -> None:
        try:
            for snapshot in snapshots:
                _asked(holder, snapshot)
        except NO_ANSWER as error:
            self.replace(f"does not take a policy ({error})")

"""Workers as Ray actors that pull their weights, and the holder of these weights.

A worker asks the holder for a policy when a plan names another than it has. Tables travel through the object store and
are read in place. What Ray cannot do for a process that hangs - show its stacks, end it although it is stopped - is
done from outside: on this node by the transport itself, on another by a caretaker there.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import ray
from ray._private import worker as ray_worker
from ray._private.state import actors

from t6gps.service import cluster, processes
from t6gps.service.cluster import start_actor
from t6gps.service.processes import Process
from t6gps.service.sampler import Failure, Runner, attempt, policy_digest, settings_digest
from t6gps.service.transport import Alive, Died, Done, Identity, Ready, Remains, Report, Transport
from t6gps.storage import ipc
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings

MakeWorker = Callable[[RolloutSettings], Runner]
Answer = tuple[tuple[pa.Buffer, pa.Buffer] | Failure | None, str]
PULL_DEADLINE_S = 10.0
EXAMINE_DEADLINE_S = 0.6
"""A caretaker that has not answered by then is cut off, and its node with it."""
HOLDER_PING_S, HOLDER_START_S = 1.0, 60.0
"""How often the holder is asked for a sign of life, and how long its process may take to start and give one."""
VERSIONS_HELD_N = 2
_log = logging.getLogger(__name__)


class HolderActor:
    """Holds the newest weights for whoever asks."""

    def __init__(self) -> None:
        self._held: dict[int, PolicySnapshot] = {}

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Take a policy, and forget all but the last ones."""
        self._held[snapshot.version] = snapshot
        for version in sorted(self._held)[:-VERSIONS_HELD_N]:
            del self._held[version]

    def version(self, version: int) -> PolicySnapshot | None:
        """The policy of that version, None when it is not held."""
        return self._held.get(version)

    def ping(self) -> int:
        """Newest version held; -1 for none."""
        return max(self._held, default=-1)


class WorkerActor:
    """A worker in a process of its own, which pulls the policy that its plan names."""

    def __init__(self) -> None:
        self._process = processes.dump_stacks_on_signal()
        self._worker: Runner | None = None
        self._holder: Any = None
        self._snapshot: PolicySnapshot | None = None
        self._digest = ""

    def open(self, make_worker: MakeWorker, settings: RolloutSettings, holder: Any) -> tuple[Identity, Process, str]:
        """Make the worker; who it is, its process, and the node in Ray's words."""
        self._worker, self._holder = make_worker(settings), holder
        address: str = ray.util.get_node_ip_address()  # type: ignore[no-untyped-call]
        identity = Identity(os.getpid(), address, settings_digest(settings.model_dump_json()))
        return identity, self._process, cluster.this_node()

    def ping(self) -> None:
        """A sign of life."""

    def follow(self, holder: Any) -> None:
        """Pull policies from another holder from now on."""
        self._holder = holder

    def run(self, plan: EpisodePlan) -> Answer:
        """Frames and summary, a Failure, or None without the policy; and the policy's digest."""
        if self._worker is None:
            raise RunError("a worker must be opened before it runs plans")
        if self._snapshot is None or self._snapshot.version != plan.policy_version:
            try:
                self._snapshot = ray.get(self._holder.version.remote(plan.policy_version), timeout=PULL_DEADLINE_S)
            except ray.exceptions.RayError:
                return None, ""  # the holder has died; its successor will be named
            if self._snapshot is None:
                return None, ""
            self._digest = policy_digest(self._snapshot)
        result = attempt(self._worker, plan, self._snapshot)
        if isinstance(result, Failure):
            return result, self._digest
        return (ipc.pack(result.frames), ipc.pack(result.summary)), self._digest


class CaretakerActor:
    """Looks at the workers of its node from outside, and ends them."""

    def __init__(self) -> None:
        self._logs = _logs()

    def examine(self, process: Process, died: bool) -> Remains:
        return _remains(process, self._logs, died)

    def kill(self, process: Process) -> None:
        processes.kill(process)


def _logs() -> Path:
    """Where the processes of this node write their logs."""
    return Path(ray_worker._global_node.get_logs_dir_path())  # type: ignore[attr-defined]


def _remains(process: Process, logs: Path, died: bool) -> Remains:
    """What is left of a process of this machine, which has died or does not go on.

    The worker is blameless when somebody stopped it, or when it has died without a word: one that fails by itself
    leaves a traceback in its log, also after a fault in C.
    """
    log = processes.log_tail(logs, process.pid)
    blameless = not processes.fault_in(log) if died else processes.stopped(process)
    return Remains(processes.stacks(process), log, blameless)


def _how(error: Exception) -> str:
    """How a process ended, without Ray's guesses at why."""
    text = " ".join(str(error).split()).partition(" Some common causes")[0]
    for start in ("Worker exit type: ", "The actor died because "):
        text = text.partition(start)[2] or text
    return text


class Remote:
    """A worker as the transport knows it: its actor, and its process once it is ready."""

    def __init__(self, actor: Any) -> None:
        self.actor = actor
        self.process: Process | None = None
        self.node = ""
        self.died = False
        self.exited = False  # it died by leaving, as Ray has seen, or for want of memory


class RayTransport(Transport):
    """Workers as actors, and the holder of the weights, which is replaced from a backup when it dies."""

    def __init__(self, make_worker: MakeWorker, settings: RolloutSettings, cpus_per_worker: float) -> None:
        self._make_worker, self._settings, self._cpus = make_worker, settings, cpus_per_worker
        self._node, self._logs = cluster.this_node(), _logs()
        self._caretakers: dict[str, Any] = {}
        self._asked: dict[Any, tuple[Remote, EpisodePlan | str]] = {}
        self._remotes: set[Remote] = set()
        self._held: dict[int, PolicySnapshot] = {}
        self._holder = start_actor(HolderActor, where=self._node)
        self._holder_pong: Any = None
        self._holder_pinged_s = 0.0
        self.holders_n = 1

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Give the holder the newest policy, and keep it in case the holder dies.

        Nothing is done for a policy that is held. RunError for one that is older than those.
        """
        if snapshot.version in self._held:
            return
        newest = max(self._held, default=snapshot.version)
        if snapshot.version < newest:
            raise RunError(f"policy versions only grow: version {newest} is published, found {snapshot.version}")
        self._held[snapshot.version] = snapshot
        for version in sorted(self._held)[:-VERSIONS_HELD_N]:
            del self._held[version]
        try:
            ray.get(self._holder.publish.remote(snapshot), timeout=HOLDER_START_S)
        except ray.exceptions.RayError:
            self._replace_holder()

    def start(self, slot: int, incarnation: int) -> Remote:
        remote = Remote(start_actor(WorkerActor, cpus=self._cpus))
        self._asked[remote.actor.open.remote(self._make_worker, self._settings, self._holder)] = remote, "open"
        self._remotes.add(remote)
        return remote

    def send(self, handle: Remote, plan: EpisodePlan) -> None:
        self._asked[handle.actor.run.remote(plan)] = handle, plan

    def ping(self, handle: Remote) -> None:
        self._asked[handle.actor.ping.remote()] = handle, "ping"

    def poll(self, wait_s: float) -> list[Report]:
        self._watch_holder()
        awaited = [*self._asked, *([] if self._holder_pong is None else [self._holder_pong])]
        if not awaited:
            time.sleep(wait_s)
            return []
        found, _ = ray.wait(awaited, num_returns=1, timeout=wait_s)
        if found:
            found, _ = ray.wait(awaited, num_returns=len(awaited), timeout=0)
        if self._holder_pong in found:
            found.remove(self._holder_pong)
            self._hear_holder()
        return [self._report(reference, *self._asked.pop(reference)) for reference in found]

    def _report(self, reference: Any, remote: Remote, asked: EpisodePlan | str) -> Report:
        try:
            answer = ray.get(reference)
        except ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, Exception) else error
            return Died(remote, type(cause).__name__, str(cause))
        except ray.exceptions.RayError as error:
            how = _how(error)
            memory = isinstance(error, ray.exceptions.OutOfMemoryError)
            remote.died, remote.exited = True, memory or ("exit code" in how and "SIGTERM" not in how)
            return Died(remote, type(error).__name__, how)
        if isinstance(asked, EpisodePlan):
            result, digest = answer
            if isinstance(result, tuple):
                result = Episode(*map(ipc.unpack, result))
            return Done(remote, asked, result, digest)
        if asked == "ping":
            return Alive(remote)
        identity, remote.process, remote.node = answer
        if remote.node != self._node and remote.node not in self._caretakers:
            self._caretakers[remote.node] = start_actor(CaretakerActor, where=remote.node)
        return Ready(remote, identity)

    def examine(self, handle: Remote) -> Remains:
        if handle.process is None:
            return Remains("the process was never ready")
        if handle.node == self._node:
            remains = _remains(handle.process, self._logs, handle.died)
        else:
            remains = self._examine_there(handle.process, handle.node, handle.died)
        return replace(remains, blameless=remains.blameless and not handle.exited)

    def _examine_there(self, process: Process, node: str, died: bool) -> Remains:
        if node in self._caretakers:
            try:
                asked = self._caretakers[node].examine.remote(process, died)
                remains: Remains = ray.get(asked, timeout=EXAMINE_DEADLINE_S)
                return remains
            except ray.exceptions.ActorDiedError:
                del self._caretakers[node]  # the next worker that is ready there brings another
            except ray.exceptions.RayError as error:
                _log.info("the caretaker of node %s does not answer: %s", node, type(error).__name__)
        return Remains(f"its node does not answer ({node})", blameless=True)

    def kill(self, handle: Remote) -> None:
        ray.kill(handle.actor)
        if handle.process is not None and handle.node == self._node:
            processes.kill(handle.process)  # a stopped process does not hear Ray
        elif handle.node in self._caretakers:
            self._caretakers[handle.node].kill.remote(handle.process)
        self._asked = {key: value for key, value in self._asked.items() if value[0] is not handle}
        self._remotes.discard(handle)

    def placed(self, handle: Remote) -> bool:
        known = actors(handle.actor._actor_id.hex())
        return bool(known) and known["State"] not in ("DEPENDENCIES_UNREADY", "PENDING_CREATION")

    def free_workers(self) -> int:
        return cluster.free_workers(self._cpus)

    def _watch_holder(self) -> None:
        now = time.monotonic()
        if self._holder_pong is None:
            if now - self._holder_pinged_s >= HOLDER_PING_S:
                self._holder_pong, self._holder_pinged_s = self._holder.ping.remote(), now
        elif now - self._holder_pinged_s > HOLDER_START_S:
            self._replace_holder()

    def _hear_holder(self) -> None:
        try:
            ray.get(self._holder_pong)
            self._holder_pong = None
        except ray.exceptions.RayError:
            self._replace_holder()

    def _replace_holder(self) -> None:
        _log.warning("the holder of the weights has died; another one takes its place")
        ray.kill(self._holder)
        self._holder = start_actor(HolderActor, where=self._node)
        for version in sorted(self._held):
            self._holder.publish.remote(self._held[version])
        for remote in self._remotes:
            remote.actor.follow.remote(self._holder)
        self._holder_pong, self._holder_pinged_s = None, time.monotonic()
        self.holders_n += 1

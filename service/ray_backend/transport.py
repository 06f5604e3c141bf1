"""Workers as Ray actors, which pull their weights when a plan names other ones than they have.

Plans and episodes go past Ray (`channel`).
What Ray cannot do for a process that hangs - show its stacks, end it although it is stopped - is done from outside: on
this node by the transport itself, on another by a caretaker there.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import ray
from ray._private import worker as ray_worker
from ray._private.state import actors

from t6gps.service.pool import control
from t6gps.service.pool.attempt import Failure, Runner, attempt, policy_digest, settings_digest
from t6gps.service.pool.transport import Alive, Died, Done, Identity, Ready, Remains, Report, Transport
from t6gps.service.ray_backend import channel, cluster, policy_server, processes
from t6gps.service.ray_backend.channel import Address, Cut, Hub
from t6gps.service.ray_backend.cluster import start_actor
from t6gps.service.ray_backend.policy_server import Weights
from t6gps.service.ray_backend.processes import Process
from t6gps.storage import ipc
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings

MakeWorker = Callable[[RolloutSettings], Runner]
EXAMINE_DEADLINE_S = 0.6
"""A caretaker that has not answered by then is cut off, and its node with it."""
LOOK_S = 1.0
"""How often Ray is asked how everybody is; at once where a line has ended."""
VAIN_PULL_S = 0.2
"""How long a worker waits after it could not pull its policy: another holder may be named meanwhile."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Greeting:
    """A worker's first message: who it is, its process, and the node in Ray's words."""

    identity: Identity
    process: Process | None
    node: str


@dataclass(frozen=True)
class Answer:
    """What became of a plan: an episode, in the memory beside this, a failure, or nothing for want of the policy.

    unheard    the holder that did not answer
    """

    plan: EpisodePlan
    failure: Failure | None = None
    policy_digest: str = ""
    unheard: Address | None = None


class WorkerActor:
    """A worker in a process of its own, which pulls the policy that its plan names."""

    def __init__(self) -> None:
        self._process = processes.dump_stacks_on_signal()
        self._holder: Address | None = None
        self._snapshot: PolicySnapshot | None = None
        self._digest = ""

    def work(self, make_worker: MakeWorker, settings: RolloutSettings, address: Address) -> str:
        """Make a worker, and do what the supervisor says until their line is cut; how it was.

        The supervisor says a plan, or who holds the weights from now on, or nothing to get a sign of life.
        """
        worker = make_worker(settings)
        here: str = ray.util.get_node_ip_address()  # type: ignore[no-untyped-call]
        identity = Identity(os.getpid(), here, settings_digest(settings.model_dump_json()))
        try:
            with channel.connect(address) as line:
                channel.send(line, Greeting(identity, self._process, cluster.this_node()))
                while True:
                    asked, _ = channel.receive(line)
                    if isinstance(asked, EpisodePlan):
                        channel.send(line, *self._run(worker, asked))
                    elif asked is None:
                        channel.send(line, None)
                    else:
                        self._holder = asked
        except (EOFError, OSError) as error:
            return f"{type(error).__name__}: {error}"

    def _run(self, worker: Runner, plan: EpisodePlan) -> tuple[Answer, pa.Buffer]:
        """An answer, and the memory beside it."""
        snapshot, unheard = None, None
        try:
            snapshot = self._pulled(plan.policy_version)
        except policy_server.NO_ANSWER:
            unheard = self._holder
        if snapshot is None:
            time.sleep(VAIN_PULL_S)
            return Answer(plan, unheard=unheard), channel.NOTHING
        result = attempt(worker, plan, snapshot)
        if isinstance(result, Failure):
            return Answer(plan, result, self._digest), channel.NOTHING
        return Answer(plan, None, self._digest), ipc.pack(result.frames, result.summary)

    def _pulled(self, version: int) -> PolicySnapshot | None:
        """The policy of that version; None when nobody has it."""
        if self._snapshot is None or self._snapshot.version != version:
            self._snapshot = None if self._holder is None else policy_server.pull(self._holder, version)
            if self._snapshot is not None:
                self._digest = policy_digest(self._snapshot)
        return self._snapshot


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
    """A worker as the transport knows it: its actor, the number of its line, and its process once it is ready."""

    def __init__(self, actor: Any, number: int) -> None:
        self.actor, self.number = actor, number
        self.process: Process | None = None
        self.node = ""
        self.died = False
        self.exited = False  # it died by leaving, as Ray has seen, or for want of memory
        self.cut = False  # its line has ended, and soon it is known why
        self.cut_off = False  # its line broke, and nothing else happened to it


class RayTransport(Transport):
    """Workers as actors, with their lines in a hub, and the weights that they pull."""

    def __init__(self, hub: Hub, make_worker: MakeWorker, settings: RolloutSettings, cpus_per_worker: float) -> None:
        self._make_worker, self._settings, self._cpus = make_worker, settings, cpus_per_worker
        self._node, self._logs = cluster.this_node(), _logs()
        self._caretakers: dict[str, Any] = {}
        self._hub = hub
        self._remotes: dict[int, Remote] = {}
        self._at_work: dict[Any, Remote] = {}  # by the call in which it works, which ends with it
        self._look_s = 0.0  # when Ray is asked next
        self._weights = Weights(hub.host, self._node)
        self._holder: Address | None = None  # as the workers know it

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Let the workers pull the newest policy. RunError for one that is older than those that were published."""
        self._weights.publish(snapshot)
        self._name_holder()
        self._look_s = 0.0

    def start(self, slot: int, incarnation: int) -> Remote:
        address = self._hub.open()
        remote = Remote(start_actor(WorkerActor, cpus=self._cpus), address.number)
        at_work = remote.actor.work.remote(self._make_worker, self._settings, address)
        return self._started(remote, at_work)

    def _started(self, remote: Remote, at_work: Any) -> Remote:
        self._remotes[remote.number] = self._at_work[at_work] = remote
        self._look_s = 0.0
        return remote

    def send(self, handle: Remote, plan: EpisodePlan) -> None:
        self._hub.send(handle.number, plan)

    def ping(self, handle: Remote) -> None:
        self._hub.send(handle.number, None)

    def poll(self, wait_s: float) -> list[Report]:
        reports: list[Report] = []
        for number, said, packed in self._hub.hear(wait_s):
            if number in self._remotes:
                reports += self._reports(self._remotes[number], said, packed)
        if time.monotonic() >= self._look_s:
            reports += self._ends()
            self._weights.watch()
            self._name_holder()
            self._look_s = time.monotonic() + (control.TICK_S if self._in_motion() else LOOK_S)
        return reports

    def _in_motion(self) -> bool:
        """True while somebody starts or is about to end: Ray is asked often then."""
        starting = self._weights.holder is None
        return starting or any(remote.cut or not remote.node for remote in self._remotes.values())

    def _reports(self, remote: Remote, said: Greeting | Answer | Cut | None, packed: pa.Buffer) -> list[Report]:
        if said is None:
            return [Alive(remote)]
        if isinstance(said, Cut):
            remote.cut, self._look_s = True, 0.0
            return []
        if isinstance(said, Answer):
            if said.unheard is not None and said.unheard == self._weights.holder:
                self._weights.replace("does not answer")
                self._look_s = 0.0
            return [Done(remote, said.plan, said.failure or _episode(packed), said.policy_digest)]
        remote.process, remote.node = said.process, said.node
        if self._holder is not None:
            self._hub.send(remote.number, self._holder)
        if remote.node != self._node and remote.node not in self._caretakers:
            self._caretakers[remote.node] = start_actor(CaretakerActor, where=remote.node)
        return [Ready(remote, said.identity)]

    def _ends(self) -> list[Report]:
        """Of the workers that have ended, and with them the call in which they work."""
        if not self._at_work:
            return []
        over, _ = ray.wait(list(self._at_work), num_returns=len(self._at_work), timeout=0)
        return [_end(self._at_work.pop(call), call) for call in over]

    def examine(self, handle: Remote) -> Remains:
        if handle.process is None:
            return Remains("the process was never ready")
        if handle.node == self._node:
            remains = _remains(handle.process, self._logs, handle.died)
        else:
            remains = self._examine_there(handle.process, handle.node, handle.died)
        return replace(remains, blameless=(remains.blameless or handle.cut_off) and not handle.exited)

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
        self._hub.cut(handle.number)
        del self._remotes[handle.number]
        self._at_work = {call: remote for call, remote in self._at_work.items() if remote is not handle}

    def placed(self, handle: Remote) -> bool:
        known = actors(handle.actor._actor_id.hex())
        return bool(known) and known["State"] not in ("DEPENDENCIES_UNREADY", "PENDING_CREATION")

    def free_workers(self) -> int:
        return cluster.free_workers(self._cpus)

    def _name_holder(self) -> None:
        """Tell the workers where to pull from when that has changed; those that have no line yet, when they have."""
        if self._weights.holder in (None, self._holder):
            return
        self._holder = self._weights.holder
        for remote in self._remotes.values():
            if remote.node:
                self._hub.send(remote.number, self._holder)


def _episode(packed: pa.Buffer) -> Episode | None:
    """What lies in the memory beside an answer."""
    if not packed.size:
        return None
    frames, summary = ipc.unpack(packed, 2)
    return Episode(frames, summary, packed)


def _end(remote: Remote, call: Any) -> Died:
    """How a worker ended: its line broke, it raised an error, or its process died as Ray tells."""
    try:
        how = ray.get(call)
        remote.cut_off = True
        return Died(remote, "CutOff", how)
    except ray.exceptions.RayTaskError as error:
        cause = error.cause if isinstance(error.cause, Exception) else error
        return Died(remote, type(cause).__name__, str(cause))
    except ray.exceptions.RayError as error:
        how = _how(error)
        memory = isinstance(error, ray.exceptions.OutOfMemoryError)
        remote.died, remote.exited = True, memory or ("exit code" in how and "SIGTERM" not in how)
        return Died(remote, type(error).__name__, how)

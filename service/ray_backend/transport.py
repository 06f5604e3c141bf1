"""Workers as Ray actors. A plan is a call, and its result comes back by itself: nobody asks Ray whether it is there.

Results are futures that Ray completes in a thread of its own, which puts them in a queue; the supervisor reads the
queue. A call that never ends - a process that hangs, a node that is cut off - is noticed by the supervisor's deadlines.
"""

from __future__ import annotations

import logging
import math
import time
from collections import Counter
from concurrent.futures import Future
from dataclasses import dataclass, replace
from queue import Empty, SimpleQueue
from typing import Any

import ray

from t6gps.service import logs
from t6gps.service.logs import Role
from t6gps.service.pool.attempt import Failure
from t6gps.service.pool.deadlines import Timings
from t6gps.service.pool.messages import Alive, Died, PostMortem, Ready
from t6gps.service.pool.state import WorkerId
from t6gps.service.pool.transport import Done, Report, Transport
from t6gps.service.ray_backend import cluster, node_agent, private, processes
from t6gps.service.ray_backend.cluster import Actor, Reference, start_actor
from t6gps.service.ray_backend.node_agent import NodeAgentActor
from t6gps.service.ray_backend.policy_server import PolicyServer
from t6gps.service.ray_backend.processes import Process
from t6gps.service.ray_backend.worker_actor import Answer, MakeWorker, Started, WorkerActor
from t6gps.storage import ipc
from t6gps.storage.records import Episode, EpisodePlan
from t6gps.workers.settings import RolloutSettings

SILENT_NODE_S = 5.0
"""A node whose agent did not answer is not asked again for so long: its workers are lost together."""
AGENT_DEATHS_N = 5
"""A node whose agent has died so often gets no other: its workers are lost when something goes wrong there."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SharedEpisode(Episode):
    """An episode that lies in Ray's object store: `reference` leads another process to its `worker_actor.Answer`."""

    reference: Reference = None


@dataclass
class Remote:
    """A worker as the transport knows it: its actor, and its process and node once it is ready.

    exited   it died by leaving, as Ray has seen, or for want of memory
    """

    actor: Actor
    process: Process | None = None
    node: str = ""
    died: bool = False
    exited: bool = False


@dataclass(frozen=True)
class Call:
    """A call of a worker's actor: `plan` where it runs one."""

    worker: WorkerId
    reference: Reference
    plan: EpisodePlan | None = None


class RayTransport(Transport):
    """Workers as actors, and the policies that they pull.

    policies   the policy server
    """

    def __init__(
        self, make_worker: MakeWorker, settings: RolloutSettings, cpus_per_worker: float, timings: Timings
    ) -> None:
        self._make_worker, self._settings, self._cpus = make_worker, settings, cpus_per_worker
        self._timings = timings
        self._node, self._logs = cluster.this_node(), private.logs_folder()
        self._agents: dict[str, Actor] = {}
        self._agent_deaths: Counter[str] = Counter()
        self._silent_s: dict[str, float] = {}
        self._remotes: dict[WorkerId, Remote] = {}
        self._over: SimpleQueue[tuple[Call, Future[Any], float]] = SimpleQueue()
        self.policies = PolicyServer(self._node, timings)
        self._followed = self.policies.source.number
        self._asked_nodes = False

    def start(self, worker: WorkerId) -> None:
        actor = start_actor(WorkerActor, logs.other(Role.WORKER, slot=worker.slot), cpus=self._cpus)
        self._begin(worker, Remote(actor), actor.open.remote(self._make_worker, self._settings, self.policies.source))

    def _begin(self, worker: WorkerId, remote: Remote, opened: Reference) -> None:
        self._remotes[worker] = remote
        self._await(Call(worker, opened))

    def send(self, worker: WorkerId, plan: EpisodePlan) -> None:
        run = self._remotes[worker].actor.run.remote(plan, self._timings.policy_answer_s)
        self._await(Call(worker, run, plan))

    def ping(self, worker: WorkerId) -> None:
        self._await(Call(worker, self._remotes[worker].actor.ping.remote()))

    def _follow(self) -> None:
        """Lead the workers to the policy server when it was replaced."""
        if self.policies.source.number != self._followed:
            self._followed = self.policies.source.number
            for remote in self._remotes.values():
                remote.actor.follow.remote(self.policies.source)

    def _await(self, call: Call) -> None:
        call.reference.future().add_done_callback(lambda future: self._over.put((call, future, time.monotonic())))

    def poll(self, wait_s: float) -> list[Report]:
        self.policies.watch()
        self._follow()
        over = []
        try:
            over.append(self._over.get(wait_s > 0, wait_s))
            while True:
                over.append(self._over.get_nowait())
        except Empty:
            return [self._report(*each) for each in over if each[0].worker in self._remotes]

    def _report(self, call: Call, future: Future[Any], at_s: float) -> Report:
        worker, remote = call.worker, self._remotes[call.worker]
        try:
            result = future.result()
        except ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, Exception) else error
            return Died(worker, type(cause).__name__, str(cause))
        except ray.exceptions.RayError as error:
            how = _how(error)
            memory = isinstance(error, ray.exceptions.OutOfMemoryError)
            remote.died, remote.exited = True, memory or ("exit code" in how and "SIGTERM" not in how)
            return Died(worker, type(error).__name__, how)
        if isinstance(result, Answer):
            return self._done(call, result, at_s)
        if isinstance(result, Started):
            return self._ready(worker, remote, result)
        return Alive(worker)

    def _ready(self, worker: WorkerId, remote: Remote, started: Started) -> Ready:
        remote.process, remote.node = started.process, started.identity.node_id
        lasting = self._agent_deaths[remote.node] < AGENT_DEATHS_N
        if remote.node != self._node and remote.node not in self._agents and lasting:
            self._agents[remote.node] = start_actor(NodeAgentActor, logs.other(Role.NODE_AGENT), where=remote.node)
        return Ready(worker, started.identity)

    def _done(self, call: Call, answer: Answer, at_s: float) -> Done:
        assert call.plan is not None, "only plans have answers"
        result: Episode | Failure | None = answer.failure
        if answer.packed is not None:
            frames, summary = ipc.unpack(answer.packed, 2)
            result = SharedEpisode(frames, summary, answer.packed, call.reference)
        elif answer.silent_server is not None:
            self.policies.missed(answer.silent_server)
            self._follow()
        return Done(call.worker, call.plan, result, at_s, answer.policy_digest)

    def examine(self, worker: WorkerId) -> PostMortem:
        remote = self._remotes[worker]
        if remote.process is None:
            return PostMortem("the process was never ready")
        if remote.node == self._node:
            post_mortem = node_agent.post_mortem(remote.process, self._logs, remote.died)
        else:
            post_mortem = self._examine_there(remote.process, remote.node, remote.died)
        return replace(post_mortem, episode_at_fault=post_mortem.episode_at_fault or remote.exited)

    def _examine_there(self, process: Process, node: str, died: bool) -> PostMortem:
        silent_s = time.monotonic() - self._silent_s.get(node, -math.inf)
        if node in self._agents and silent_s > SILENT_NODE_S:
            try:
                examined = self._agents[node].examine.remote(process, died)
                post_mortem: PostMortem = ray.get(examined, timeout=self._timings.examine_s)
                return post_mortem
            except ray.exceptions.ActorDiedError:
                del self._agents[node]  # the next worker that is ready there brings another
                self._agent_deaths[node] += 1
            except ray.exceptions.RayError as error:
                self._silent_s[node] = time.monotonic()
                _log.info("the agent of node %s does not answer: %s", node, type(error).__name__)
        return PostMortem(f"its node does not answer ({node})", episode_at_fault=False)

    def kill(self, worker: WorkerId) -> None:
        remote = self._remotes.pop(worker, None)
        if remote is None:  # it was to start when something went wrong
            return
        ray.kill(remote.actor)
        if remote.process is not None and remote.node == self._node:
            processes.kill(remote.process)  # a stopped process does not hear Ray
        elif remote.node in self._agents:
            self._agents[remote.node].kill.remote(remote.process)

    def close(self) -> None:
        """End what looks after the workers: the policy server, and the agents of other nodes."""
        if not ray.is_initialized():
            return
        if self._asked_nodes:
            self.ask_nodes(0)
        for actor in (self.policies.source.actor, *self._agents.values()):
            ray.kill(actor)

    def placed(self, worker: WorkerId) -> bool:
        return private.is_placed(self._remotes[worker].actor)

    def ask_nodes(self, workers: int) -> None:
        cluster.ask_nodes(workers, self._cpus)
        self._asked_nodes = workers > 0

    def free_workers(self) -> int:
        return cluster.free_workers(self._cpus)


def _how(error: Exception) -> str:
    """How a process ended, without Ray's guesses at why."""
    text = " ".join(str(error).split()).partition(" Some common causes")[0]
    for start in ("Worker exit type: ", "The actor died because "):
        text = text.partition(start)[2] or text
    return text

"""A worker in a process of its own: plans come in as calls, episodes go out as Arrow through the object store."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import pyarrow as pa
import ray

from t6gps.service import logs, provenance, threads
from t6gps.service.logs import Speaker
from t6gps.service.pool.attempt import Failure, Runner, attempt, policy_digest, settings_digest
from t6gps.service.pool.state import Identity
from t6gps.service.ray_backend import cluster, processes
from t6gps.service.ray_backend.policy_server import PolicySource
from t6gps.service.ray_backend.processes import Process
from t6gps.storage import ipc
from t6gps.storage.errors import RunError
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings

MakeWorker = Callable[[RolloutSettings], Runner]
VAIN_PULL_S = 0.2
"""How long a worker waits after it could not pull its policy: another server may be named meanwhile."""


@dataclass(frozen=True)
class Started:
    """Who a worker is, and its process."""

    identity: Identity
    process: Process | None


@dataclass(frozen=True)
class Answer:
    """What became of a plan: an episode, a failure, or neither for want of the policy.

    packed          frames and summary as one piece of memory (`ipc.pack`), which readers use where it lies
    silent_server   number of a policy server that did not answer
    """

    packed: pa.Buffer | None = None
    failure: Failure | None = None
    policy_digest: str = ""
    silent_server: int | None = None


class WorkerActor:
    """Runs plans one after the other, each with the policy that it names."""

    def __init__(self, speaker: Speaker) -> None:
        logs.begin(speaker)
        self._speaker = speaker
        self._process = processes.dump_stacks_on_signal()
        self._worker: Runner | None = None
        self._source: PolicySource | None = None
        self._snapshot: PolicySnapshot | None = None
        self._digest = ""

    def open(self, make_worker: MakeWorker, settings: RolloutSettings, source: PolicySource) -> Started:
        """Make the worker, which pulls policies from `source`."""
        self._worker, self._source = make_worker(settings), source
        threads.limit()
        address: str = ray.util.get_node_ip_address()  # type: ignore[no-untyped-call]
        digest = settings_digest(settings.model_dump_json())
        identity = Identity(os.getpid(), address, cluster.this_node(), digest, provenance.build())
        return Started(identity, self._process)

    def ping(self) -> None:
        """A sign of life."""

    def follow(self, source: PolicySource) -> None:
        """Pull policies from another server from now on."""
        self._source = source

    def run(self, plan: EpisodePlan, patience_s: float) -> Answer:
        """Run a plan; the policy server has `patience_s` to answer."""
        if self._worker is None or self._source is None:
            raise RunError("a worker must be opened before it runs plans")
        try:
            snapshot = self._pulled(plan.policy_version, self._source, patience_s)
        except ray.exceptions.RayError:  # the server has died or stalls
            return self._without_policy(self._source.number)
        if snapshot is None:
            return self._without_policy(None)
        with logs.speaking(replace(self._speaker, episode=plan.episode_id)):
            result = attempt(self._worker, plan, snapshot)
        if isinstance(result, Failure):
            return Answer(failure=result, policy_digest=self._digest)
        return Answer(ipc.pack(result.frames, result.summary), policy_digest=self._digest)

    def _pulled(self, version: int, source: PolicySource, patience_s: float) -> PolicySnapshot | None:
        """The policy of that version; None when the server has it not."""
        if self._snapshot is None or self._snapshot.version != version:
            self._snapshot = ray.get(source.actor.pull.remote(version), timeout=patience_s)
            self._digest = policy_digest(self._snapshot) if self._snapshot else ""
        return self._snapshot

    def _without_policy(self, silent_server: int | None) -> Answer:
        time.sleep(VAIN_PULL_S)
        return Answer(silent_server=silent_server)

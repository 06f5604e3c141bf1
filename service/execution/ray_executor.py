"""The executor that runs workers, learner and policy server as Ray actors.

Ray restarts nothing: the supervisor replaces workers and the policy server, the training loop the learner.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

import ray

from t6gps.learner.phases import Phase
from t6gps.learner.port import Progress
from t6gps.service import caller, provenance
from t6gps.service.config import Config
from t6gps.service.execution.executor import Executor, Keep, Purpose
from t6gps.service.execution.ray_learner import RayLearner
from t6gps.service.pool.attempt import policy_digest, settings_digest
from t6gps.service.pool.deadlines import TIMINGS, EpisodeTimes, Timings
from t6gps.service.pool.decision_log import DecisionLog
from t6gps.service.pool.outside import Nobody
from t6gps.service.pool.pool import TICK_S, Pool
from t6gps.service.pool.state import PoolState, RunState
from t6gps.service.ray_backend import cluster
from t6gps.service.ray_backend.cluster import Reference
from t6gps.service.ray_backend.transport import RayTransport, SharedEpisode
from t6gps.service.ray_backend.worker_actor import MakeWorker
from t6gps.service.steering import requests
from t6gps.service.steering.desk import Desk
from t6gps.service.steering.requests import What
from t6gps.storage.catalog import Run
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.worker import RolloutWorker


class RayExecutor(Executor):
    """Workers, learner and policy server as actors on Ray.

    They use the Ray that this process is connected to, or join the cluster that RAY_ADDRESS names. Without either, they
    start an embedded one on the loopback address with a token of its own (`cluster.connection`).
    """

    def __init__(
        self,
        config: Config,
        run: Run | None = None,
        make_worker: MakeWorker = RolloutWorker,
        timings: Timings = TIMINGS,
    ) -> None:
        super().__init__(config, run)
        self._learner: RayLearner | None = None
        self._keep_ahead: Keep | None = None
        self._closed, self._timings = False, timings
        state = PoolState(
            config.run.workers,
            settings_digest(config.rollout.model_dump_json()),
            self.ledger,
            timings,
            EpisodeTimes(timings.shortest_episode_s),
            config.run.autoscale,
            build=provenance.build(),
        )
        with ExitStack() as started:
            most = started.enter_context(cluster.connection(config))
            self.transport = RayTransport(make_worker, config.rollout, config.run.cpus_per_worker, timings)
            started.callback(self.transport.close)
            log = None if run is None else DecisionLog(run.pool)
            outside = Nobody() if run is None else Desk(run, most)
            self.pool = Pool(state, self.transport, outside, self._quarantine, log)
            self.tend()
            self._held = started.pop_all()

    @property
    def learner(self) -> RayLearner:
        if self._learner is None:
            self._learner = RayLearner(self.config, cluster.this_node(), self._timings, self._until_done)
        return self._learner

    def sample(
        self,
        plans: Sequence[EpisodePlan],
        snapshot: PolicySnapshot,
        keep: Keep,
        purpose: Purpose = Purpose.TRAINING,
    ) -> None:
        self._begin(plans, snapshot, purpose)
        self.pool.sample(keep)

    def sample_ahead(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, keep: Keep) -> None:
        self._begin(plans, snapshot, Purpose.TRAINING)
        self._keep_ahead = keep

    def _begin(self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: Purpose) -> None:
        self._keep_ahead = None
        quarantined = self._open(plans, snapshot, purpose)
        self.transport.policies.publish(snapshot)
        while not self.transport.policies.has_the_newest(TICK_S):
            self.tend()
        self.pool.open(plans, quarantined, {snapshot.version: policy_digest(snapshot)})

    def feed(self, episode: Episode) -> None:
        assert isinstance(episode, SharedEpisode), "`sample` hands over no others"
        self.learner.add(episode.reference)

    def feed_spooled(self, files: Sequence[Path]) -> None:
        self.learner.add_spooled(files)

    def learn(self, phase: Phase) -> Progress:
        self.pool.phases.enter(phase.name)
        return self.learner.learn(phase)

    def replace_learner(self) -> None:
        if self._learner is not None:
            self._learner.kill()
        self._learner = None

    def close(self, outcome: RunState = RunState.STOPPING) -> None:
        if self._closed:
            return
        self._closed = True
        with caller.undisturbed(), self._held:
            if ray.is_initialized():  # its caller may have ended it
                self.pool.close(outcome, "" if outcome is RunState.DONE else self._why_stopped())
                self.replace_learner()

    def _why_stopped(self) -> str:
        asked = None if self.run is None else requests.read(self.run)
        return "t6gps stop" if asked is not None and asked.what is What.STOP else "Ctrl-C, SIGTERM or an error"

    def _until_done(self, reference: Reference) -> None:
        """Wait for the learner, and tend the pool meanwhile."""
        self.pool.wait("the run", "the learner", True)
        try:
            while not ray.wait([reference], timeout=TICK_S)[0]:
                self.tend()
                self.learner.check_life()
        finally:
            self.pool.wait("the run", "the learner", False)
        self.tend()

    def tend(self, phase: str | None = None) -> None:
        """Let the pool work, but not all the time, and keep what was sampled ahead."""
        if phase is not None:
            self.pool.phases.enter(phase)
        if time.monotonic() - self.pool.ticked_s < TICK_S:
            return
        self.pool.tick()
        if self._keep_ahead is not None:
            self.pool.deliver(self._keep_ahead)

"""What a supervisor spends on its decisions, for any number of workers: they exist on paper, in a time of their own.

Pool, supervisor, ledger, decision log, status and events are those of a run, in its folder. A worker on paper gives the
same episode back when its time has come. Their clock advances while the pool waits, and by the processor time that the
pool spends: so episodes pile up where it is too slow, as they would in a run.
"""

from __future__ import annotations

import heapq
import tempfile
from collections import deque
from contextlib import suppress
from pathlib import Path

from t6gps.service import seeding
from t6gps.service.bench.contenders import Enough
from t6gps.service.bench.role_clock import ThreadClock
from t6gps.service.config import Config
from t6gps.service.pool.deadlines import TIMINGS, EpisodeTimes
from t6gps.service.pool.decision_log import DecisionLog
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.messages import Alive, PostMortem, Ready
from t6gps.service.pool.pool import TICK_S, Pool
from t6gps.service.pool.state import Identity, PoolState, RunState, WorkerId
from t6gps.service.pool.transport import Done, Report, Transport
from t6gps.service.steering.desk import Desk
from t6gps.storage import catalog
from t6gps.storage.records import Episode, EpisodePlan

LEAST_N, LONGEST_S = 100, 5.0
"""So many episodes are counted at least, and no more once so much processor time is spent."""


class PaperTransport(Transport):
    """Workers on paper, each of which needs `episode_s` for an episode.

    whole   the episode that all of them give back
    own     processor time that is spent here, and so is nobody's
    """

    def __init__(self, workers_n: int, whole: Episode, episode_s: float) -> None:
        self._workers_n, self._whole, self._episode_s = workers_n, whole, episode_s
        self._pool, self.own = ThreadClock(), ThreadClock()
        self._waited_s = 0.0
        self._queues: dict[WorkerId, deque[EpisodePlan]] = {}
        self._ends: list[tuple[float, WorkerId]] = []
        self._reports: list[Report] = []
        self._pool.start()

    def clock(self) -> float:
        """What was waited, and what the pool has spent (s)."""
        return self._waited_s + self.spent_s

    @property
    def spent_s(self) -> float:
        """Processor time of this thread that was not spent here."""
        return self._pool.so_far_s() - self.own.spent_s

    def start(self, worker: WorkerId) -> None:
        self._queues[worker] = deque()
        self._reports.append(Ready(worker, Identity(1, "paper", "paper", "")))

    def send(self, worker: WorkerId, plan: EpisodePlan) -> None:
        with self.own:
            queue = self._queues[worker]
            if not queue:  # they began one after the other, so they do not end at once
                later = worker.slot / self._workers_n if plan.index < self._workers_n else 0.0
                heapq.heappush(self._ends, (self.clock() + self._episode_s * (1 + later), worker))
            queue.append(plan)

    def ping(self, worker: WorkerId) -> None:
        self._reports.append(Alive(worker))

    def poll(self, wait_s: float) -> list[Report]:
        with self.own:
            now_s = self.clock()
            if wait_s > 0 and not self._reports:
                until_s = min([now_s + wait_s, *(end_s for end_s, _ in self._ends[:1])])
                self._waited_s += max(until_s - now_s, 0.0)
                now_s = max(until_s, now_s)
            while self._ends and self._ends[0][0] <= now_s:
                at_s, worker = heapq.heappop(self._ends)
                queue = self._queues[worker]
                self._reports.append(Done(worker, queue.popleft(), self._whole, at_s))
                if queue:
                    heapq.heappush(self._ends, (at_s + self._episode_s, worker))
            reports, self._reports = self._reports, []
            return reports

    def examine(self, worker: WorkerId) -> PostMortem:
        return PostMortem()

    def kill(self, worker: WorkerId) -> None:
        del self._queues[worker]

    def placed(self, worker: WorkerId) -> bool:
        return True

    def ask_nodes(self, workers: int) -> None:
        """There are enough."""

    def free_workers(self) -> int:
        return self._workers_n


def deciding_s(config: Config, workers_n: int, whole: Episode, episode_s: float, most_n: int) -> float:
    """Processor time (s) of the supervisor's thread for an episode, from its arrival to its successor's start.

    Counted are `most_n` episodes, or fewer where they take too long. What Ray's calls, the spool and the learner take
    in that thread is not part of it.
    """
    plans = seeding.training_plans(_with_episodes(config, 2 * workers_n + most_n + 1), 0)
    with tempfile.TemporaryDirectory() as folder:
        run = catalog.create(Path(folder), "paper", config.to_json())
        transport = PaperTransport(workers_n, whole, episode_s)
        state = PoolState(workers_n, "", Ledger(), TIMINGS, EpisodeTimes(TIMINGS.shortest_episode_s))
        log = DecisionLog(run.pool)
        pool = Pool(state, transport, Desk(run, workers_n), lambda _: None, log, transport.clock)
        while state.condition is not RunState.RUNNING:
            pool.tick(TICK_S)
        pool.open(plans, [], {})
        begin_s, kept_n = 0.0, 0

        def keep(_: Episode) -> None:
            nonlocal begin_s, kept_n
            if kept_n == 0:  # from here on it is counted
                begin_s = transport.spent_s
            kept_n += 1
            if kept_n > most_n or (kept_n > LEAST_N and transport.spent_s - begin_s > LONGEST_S):
                raise Enough

        with suppress(Enough):
            pool.sample(keep)
        log.close()
        return (transport.spent_s - begin_s) / (kept_n - 1)


def _with_episodes(config: Config, episodes: int) -> Config:
    return config.model_copy(update={"run": config.run.model_copy(update={"episodes": episodes})})

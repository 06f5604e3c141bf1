"""A pool of workers that exist on paper, with a clock of their own: no process, no waiting."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from t6gps.service.pool.attempt import Failure, FailureKind
from t6gps.service.pool.deadlines import TIMINGS, EpisodeTimes
from t6gps.service.pool.decision_log import DecisionLog
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.messages import Alive, Died, Instruction, Observation, PostMortem, Ready, ScaleRequested
from t6gps.service.pool.outside import Nobody, Outside, Situation
from t6gps.service.pool.pool import Pool
from t6gps.service.pool.scaling import PLANS_PER_WORKER
from t6gps.service.pool.state import (
    Identity,
    PoolState,
    WorkerId,
)
from t6gps.service.pool.transport import Done, Report, Transport
from t6gps.service.steering import events
from t6gps.service.steering.events import Happened, Standing
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers import stub

POLICY = PolicySnapshot(0, (), 1.0, 0.2)
SETTINGS, START_S, EPISODE_S = "settings", 1.0, 0.5
SHORTEST_S = TIMINGS.shortest_episode_s


def plans(n: int) -> list[EpisodePlan]:
    return [EpisodePlan(i, 0, i, 100 + i, 4, 0, 0.0, 0.1, 0) for i in range(n)]


@dataclass
class PaperWorker:
    """A worker on paper: it is ready at a time, and has a queue, as a process has."""

    ready_s: float
    ready: bool = False
    queue: list[EpisodePlan] = field(default_factory=list)
    until_s: float = 0.0


class Paper(Transport):
    """Workers on paper. They do what they are told, but for what is in the sets below."""

    def __init__(self) -> None:
        self.now_s = 0.0
        self.room = 100
        self.alive: dict[WorkerId, PaperWorker] = {}
        self.starts: list[tuple[int, int, float]] = []
        self.reports: list[Report] = []
        self.fails_to_start = False
        self.hold_back = False
        self.settings, self.build = SETTINGS, dict[str, str]()
        self.digest = "policy"
        self.episode_s = EPISODE_S
        self.raising: set[int] = set()
        self.hanging: set[int] = set()
        self.crashing: set[int] = set()
        self.silent: set[WorkerId] = set()
        self.nodes_asked: list[int] = []
        self.most_in_flight = 0
        self.polls_n = 0

    def clock(self) -> float:
        return self.now_s

    def start(self, worker: WorkerId) -> None:
        self.starts.append((*worker, self.now_s))
        self.alive[worker] = PaperWorker(self.now_s + START_S)

    def send(self, worker: WorkerId, plan: EpisodePlan) -> None:
        paper = self.alive.get(worker)
        if paper is None:  # it has died, which is reported
            return
        assert paper.ready
        if not paper.queue:
            paper.until_s = self.now_s + self.episode_s
        paper.queue.append(plan)
        assert len(paper.queue) <= PLANS_PER_WORKER
        self.most_in_flight = max(self.most_in_flight, sum(len(each.queue) for each in self.alive.values()))

    def ping(self, worker: WorkerId) -> None:
        if worker not in self.silent:
            self.reports.append(Alive(worker))

    def poll(self, wait_s: float) -> list[Report]:
        self.now_s += wait_s
        self.polls_n += 1
        assert self.polls_n < 20_000, "the run does not end"
        for worker, paper in list(self.alive.items()):
            if not paper.ready and self.now_s >= paper.ready_s and self.placed(worker):
                if self.fails_to_start:
                    self.die(worker)
                    continue
                paper.ready = True
                self.reports.append(
                    Ready(worker, Identity(1000 + worker.slot, "paper", "paper", self.settings, self.build))
                )
            while paper.queue and self.now_s >= paper.until_s:
                if paper.queue[0].episode_id in self.hanging:
                    break
                if paper.queue[0].episode_id in self.crashing:
                    self.die(worker)
                    break
                plan, at_s = paper.queue.pop(0), paper.until_s
                paper.until_s = self.now_s + self.episode_s
                result: Episode | Failure = stub.episode(plan, POLICY)
                if plan.episode_id in self.raising:
                    result = Failure(FailureKind.RAISED, "PhysicsError", "it fell over", plan.seed, 2)
                self.reports.append(Done(worker, plan, result, at_s, self.digest))
        if self.hold_back:
            return []
        reports, self.reports = self.reports, []
        return reports

    def examine(self, worker: WorkerId) -> PostMortem:
        return PostMortem(f"stacks of {worker}", "log")

    def kill(self, worker: WorkerId) -> None:
        self.alive.pop(worker, None)
        self.reports = [report for report in self.reports if report.worker != worker]

    def placed(self, worker: WorkerId) -> bool:
        return list(self.alive).index(worker) < self.room

    def ask_nodes(self, workers: int) -> None:
        self.nodes_asked.append(workers)

    def free_workers(self) -> int:
        return max(self.room - len(self.alive), 0)

    def die(self, worker: WorkerId, error: str = "ActorDiedError") -> None:
        """The process ends; its supervisor hears of it."""
        del self.alive[worker]
        self.reports.append(Died(worker, error, "the process ended"))


class Asker(Nobody):
    """Asks for what it is told to, and keeps what it hears: events, and the condition at the end."""

    def __init__(self) -> None:
        self.requests: list[Observation] = []
        self.happened: list[Happened] = []
        self._standing: Standing | None = None

    def asked(self) -> list[Observation]:
        asked, self.requests = self.requests, []
        return asked

    def decided(self, situation: Situation, observed: Sequence[Observation], decided: Sequence[Instruction]) -> None:
        before, after = self._standing or Standing(situation.state.wanted), events.standing(situation.state)
        self.happened += events.of(before, after, situation.state, observed, decided)
        self._standing = after


class House:
    """A pool of paper workers, with its ledger."""

    def __init__(
        self,
        wanted: int,
        episodes: int = 0,
        autoscale: tuple[int, int] | None = None,
        bytes_in_flight: int = 2**30,
        log: DecisionLog | None = None,
        outside: Outside | None = None,
    ) -> None:
        self.paper, self.ledger, self.asker = Paper(), Ledger(), Asker()
        self.quarantined: list[EpisodePlan] = []
        times = EpisodeTimes(SHORTEST_S)
        state = PoolState(wanted, SETTINGS, self.ledger, TIMINGS, times, autoscale, bytes_in_flight=bytes_in_flight)
        self.pool = Pool(state, self.paper, outside or self.asker, self.quarantined.append, log, self.paper.clock)
        self.pool.open(plans(episodes), [], {0: "policy"})

    def run(self, seconds: float) -> None:
        """Tick for some time of the paper's clock."""
        end_s = self.paper.now_s + seconds
        while self.paper.now_s < end_s:
            self.pool.tick(0.1)

    def until(self, condition: Any, seconds: float) -> float:
        """Tick until the condition holds; how long that took on the paper's clock."""
        start_s = self.paper.now_s
        while not condition():
            assert self.paper.now_s - start_s < seconds, self.pool.state.reason
            self.pool.tick(0.1)
        return self.paper.now_s - start_s

    @property
    def ready(self) -> int:
        return sum(worker.ready for worker in self.pool.state.workers.values())

    def scale(self, workers: int) -> None:
        """Ask for so many workers, at the next tick."""
        self.asker.requests.append(ScaleRequested(workers))

    def sample(self, after_each: Callable[[list[int]], None] = lambda _: None) -> list[int]:
        """Numbers of the episodes in the order of their arrival; `after_each` sees those that there are so far."""
        found: list[int] = []

        def keep(episode: Episode) -> None:
            found.append(episode.episode_id)
            after_each(found)

        self.pool.sample(keep)
        return found

"""The supervisor of a run's workers: one function, `tick`, brings what is towards what is wished.

A worker is a slot with an incarnation. However one goes - crash, hang, failed start, lost node, scale-down - it goes by
`_end`: what it held goes back to the ledger, and the next tick fills the slot again if it is wanted. Slots that keep
failing wait twice as long each time; when no worker can start at all, the breaker opens and the run ends with the
reason.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

from t6gps.service.pool import control
from t6gps.service.pool.attempt import Failure
from t6gps.service.pool.control import Control
from t6gps.service.pool.deadlines import TIMINGS, EpisodeTimes, Timings
from t6gps.service.pool.ledger import Ledger
from t6gps.service.pool.transport import Alive, Died, Done, Handle, Identity, Ready, Report, Transport
from t6gps.service.pool.workers import Slot, Worker
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan

PLANS_PER_WORKER = 2
BYTES_IN_FLIGHT = 2**30
"""Episodes under way count with the size of the largest seen."""
BREAKER_N = 5
"""So many starts in a row that fail, with no worker left, open the breaker."""


class Pool:
    """Keeps `wanted` workers at work on the ledger's plans.

    expected_settings_digest    every worker must have the settings that this stands for
    quarantine                  keeps a crash bundle; called with a plan whose last attempt has failed

    ticked_s    when the last round began (s, `clock`)
    """

    def __init__(
        self,
        transport: Transport,
        ledger: Ledger,
        wanted: int,
        expected_settings_digest: str,
        control_: Control,
        quarantine: Callable[[EpisodePlan], None],
        clock: Callable[[], float] = time.monotonic,
        autoscale: tuple[int, int] | None = None,
        timings: Timings = TIMINGS,
    ) -> None:
        self.ledger = ledger
        self.wanted = wanted
        self.state, self.reason = "DEGRADED", "the workers are starting"
        self.phase = "starting"
        self._policy_digests: dict[int, str] = {}
        self.workers: dict[int, Worker] = {}
        self.ticked_s = -math.inf
        self.counters = {"started": 0, "crashed": 0, "hung": 0, "drained": 0}
        self._transport = transport
        self._digest = expected_settings_digest
        self._control = control_
        self._quarantine = quarantine
        self._clock = clock
        self._autoscale = autoscale
        self._by_handle: dict[Handle, Worker] = {}
        self._slots: dict[int, Slot] = {}
        self._times = EpisodeTimes(timings.shortest_episode_s)
        self._timings = timings
        self._arrived: deque[tuple[int, Episode]] = deque()
        self._largest_bytes = 1
        self._failed_starts_n = 0
        self._last_trouble = ""
        self._free_n, self._asked_s = 0, -math.inf
        self._needed_s = -math.inf
        self._waits: dict[str, float] = {}

    def tick(self, wait_s: float = 0.0) -> None:
        """One round: hear, judge, replace, start, drain, send, tell. Waits up to `wait_s` for news.

        Raises RunError when the run cannot go on: the breaker is open, nothing but failures comes back, or a worker
        has other settings or another policy than the run.
        """
        for report in self._transport.poll(0.0):
            self._hear(report)
        now = self.ticked_s = self._clock()
        self._scale(now)
        self._replace_hung(now)
        self._drain(now)
        self._fill(now)
        self._send(now)
        self._judge()
        self._tell(now)
        if self.state == "FAILED":
            self._control.publish(self.status(now))
            raise RunError(self.reason)
        if wait_s > 0:
            for report in self._transport.poll(wait_s):
                self._hear(report)

    def open(self, policy_digests: Mapping[int, str]) -> None:
        """A new book was opened; by version, the policies that its plans name."""
        self._policy_digests = dict(policy_digests)
        self._arrived.clear()
        self.phase = "sampling"

    def sample(self, keep: Callable[[Episode], None]) -> None:
        """Let the workers run the batch until no episode is missing; see `deliver` for `keep`."""
        while self.ledger.backlog:
            self.tick(0.0 if self._arrived else control.TICK_S)
            self.deliver(keep)
        if self.ledger.hopeless:
            self.tick()

    def deliver(self, keep: Callable[[Episode], None]) -> None:
        """Hand over the episodes that are there; when `keep` returns, one is durable."""
        while self._arrived:
            episode_id, episode = self._arrived.popleft()
            keep(episode)
            self.ledger.commit(episode_id)

    def close(self, state: str, reason: str) -> None:
        """End every worker and say how the run ended."""
        for worker in list(self.workers.values()):
            self._transport.kill(worker.handle)
        self.workers.clear()
        self._by_handle.clear()
        if self.state != "FAILED":
            self.state, self.reason = state, reason
        self._control.publish(self.status(self._clock()))

    def _hear(self, report: Report) -> None:
        worker = self._by_handle.get(report.handle)
        if worker is None:
            return
        now = self._clock()
        if isinstance(report, Ready):
            self._greet(worker, report.identity, now)
        elif isinstance(report, Alive):
            worker.answered = True
        elif isinstance(report, Died):
            self._end(worker, now, "crash", report.error, report.message)
        else:
            self._take(worker, report, now)

    def _greet(self, worker: Worker, identity: Identity, now: float) -> None:
        if identity.settings_digest != self._digest:
            self._fail(f"worker {worker} has other settings than the run; install the same version on every node")
            return
        worker.identity, worker.phase, worker.since_s = identity, "idle", now
        self._failed_starts_n = 0

    def _take(self, worker: Worker, done: Done, now: float) -> None:
        if not self._acted_as_planned(worker, done):
            return
        if done.plan in worker.plans:
            worker.plans.remove(done.plan)
        took_s = now - worker.since_s
        self._begin(worker, now)
        if isinstance(done.result, Failure):
            self._failed(done.plan, done.result)
        elif done.result is None:
            self.ledger.give_back(worker.slot, worker.incarnation)
            worker.plans.clear()
        else:
            self._times.add(took_s, done.plan.steps)
            self._slots[worker.slot].failures_n = 0
            self._largest_bytes = max(self._largest_bytes, done.result.nbytes)
            if self.ledger.arrive(done.plan):
                self._arrived.append((done.plan.episode_id, done.result))

    def _acted_as_planned(self, worker: Worker, done: Done) -> bool:
        expected = self._policy_digests.get(done.plan.policy_version, done.policy_digest)
        if done.result is None or done.policy_digest == expected:
            return True
        self._fail(
            f"worker {worker} acted with another policy than version {done.plan.policy_version} of the run; "
            "its data are not kept: go on with --resume, and report this"
        )
        return False

    def _begin(self, worker: Worker, now: float) -> None:
        """The worker comes to the first of its plans."""
        worker.phase, worker.since_s, worker.answered = ("sampling" if worker.plans else "idle"), now, True
        worker.deadline_s = math.inf
        if worker.plans:
            plan = worker.plans[0]
            worker.deadline_s = now + self._times.deadline_s(plan.steps) * 2 ** self.ledger.hangs_n(plan)

    def _failed(self, plan: EpisodePlan, failure: Failure) -> None:
        self._last_trouble = f"episode {plan.episode_id}: {failure}"
        if self.ledger.fail(plan, failure):
            self._quarantine(plan)

    def _end(self, worker: Worker, now: float, kind: str, error: str, message: str) -> None:
        """The one way in which a worker goes, planned ("drained") or not ("crash", "hang")."""
        del self.workers[worker.slot], self._by_handle[worker.handle]
        if kind != "drained":
            self._mourn(worker, now, kind, error, message)
        self.counters[{"crash": "crashed", "hang": "hung", "drained": "drained"}[kind]] += 1
        self._transport.kill(worker.handle)
        self.ledger.give_back(worker.slot, worker.incarnation)

    def _mourn(self, worker: Worker, now: float, kind: str, error: str, message: str) -> None:
        self._slots[worker.slot].failed(now)
        self._last_trouble = f"worker {worker}: {error}: {message}"
        if worker.phase == "starting":
            self._failed_starts_n += 1
        remains = self._transport.examine(worker.handle)
        if worker.plans:
            plan = worker.plans[0]
            where = f"{worker}" + (f", process {worker.identity.pid}" if worker.identity else "")
            kind = "lost" if remains.blameless else kind
            failure = Failure(kind, error, message, plan.seed, None, remains.stacks, [], where, remains.log)
            self._failed(plan, failure)

    def _replace_hung(self, now: float) -> None:
        for worker in list(self.workers.values()):
            for_s, silent_s = now - worker.since_s, now - max(worker.pinged_s, worker.since_s)
            if now > worker.deadline_s:
                self._end(worker, now, "hang", "Hang", f"no result within {for_s:.1f} s")
            elif worker.phase == "starting" and for_s > self._timings.start_s and not self._pending(worker):
                self._end(worker, now, "hang", "Hang", f"not ready {for_s:.1f} s after its start")
            elif worker.phase == "idle" and not worker.answered and silent_s > self._timings.ping_deadline_s:
                self._end(worker, now, "hang", "Hang", f"no sign of life for {silent_s:.1f} s")
            elif worker.phase == "idle" and worker.answered and silent_s > self._timings.ping_s:
                self._transport.ping(worker.handle)
                worker.pinged_s, worker.answered = now, False

    def _pending(self, worker: Worker) -> bool:
        """True while a worker waits for a CPU."""
        return worker.phase == "starting" and not worker.placed and self._free_n < 1

    def _scale(self, now: float) -> None:
        starting = [worker for worker in self.workers.values() if worker.phase == "starting"]
        if (starting or self._autoscale) and now - self._asked_s >= self._timings.capacity_s:
            self._free_n, self._asked_s = self._transport.free_workers(), now
            for worker in starting:
                fresh = now - worker.since_s < self._timings.pending_after_s
                worker.placed = fresh or self._transport.placed(worker.handle)
        wish = self._control.wish()
        if wish is not None:
            self.wanted, self._autoscale = wish, None  # scaled by hand: it stays so
        if self._autoscale is None:
            return
        least, most = self._autoscale
        room = sum(not self._pending(worker) for worker in self.workers.values()) + max(self._free_n, 0)
        useful = min(most, max(least, min(room, math.ceil(self.ledger.backlog / PLANS_PER_WORKER))))
        if useful >= self.wanted:
            self.wanted, self._needed_s = useful, now
        elif now - self._needed_s > self._timings.shrink_after_s:
            self.wanted = useful

    def _drain(self, now: float) -> None:
        for worker in list(self.workers.values()):
            worker.draining = worker.slot >= self.wanted
            if not worker.draining:
                continue
            head = worker.plans[0] if worker.plans else None
            if head is None or head.episode_id not in self.ledger.leases:
                self._end(worker, now, "drained", "", "")
            elif len(worker.plans) > 1:  # the other plans go to others now; this worker is gone before it comes to them
                self.ledger.give_back(worker.slot, worker.incarnation, keep=head.episode_id)
                worker.plans = deque([head])

    def _fill(self, now: float) -> None:
        for number in range(self.wanted):
            slot = self._slots.setdefault(number, Slot())
            if number in self.workers or slot.retry_s > now:
                continue
            slot.incarnations_n += 1
            handle = self._transport.start(number, slot.incarnations_n)
            self.workers[number] = self._by_handle[handle] = Worker(number, slot.incarnations_n, handle, now)
            self._free_n -= 1
            self.counters["started"] += 1

    def _send(self, now: float) -> None:
        for _ in range(PLANS_PER_WORKER):
            for worker in self.workers.values():
                busy = worker.phase == "starting" or worker.draining or len(worker.plans) >= PLANS_PER_WORKER
                if busy or not self._credit():
                    continue
                plan = self.ledger.lease(worker.slot, worker.incarnation)
                if plan is None:
                    return
                worker.plans.append(plan)
                self._transport.send(worker.handle, plan)
                if len(worker.plans) == 1:
                    self._begin(worker, now)

    def _credit(self) -> bool:
        """True while another episode may be under way: what has arrived and is not durable yet counts."""
        under_way = len(self.ledger.leases) + self.ledger.arrived
        most = min(PLANS_PER_WORKER * max(len(self.workers), 1), max(BYTES_IN_FLIGHT // self._largest_bytes, 1))
        return under_way < most

    def _judge(self) -> None:
        """State and reason, in words."""
        if self.state == "FAILED":
            return
        ready = [worker for worker in self.workers.values() if worker.phase != "starting"]
        pending = [worker for worker in self.workers.values() if self._pending(worker)]
        if self.ledger.hopeless:
            self._fail(f"nothing but failures comes back; the last: {self._last_trouble}; replay its bundle")
        elif self._failed_starts_n >= BREAKER_N and not ready:
            self._fail(
                f"{self._failed_starts_n} workers in a row could not start; the last: {self._last_trouble}; "
                "mend the cause, then go on with --resume"
            )
        elif self.wanted == 0:
            self.state, self.reason = "PAUSED", "scaled to no workers; scale up to go on"
        elif len(ready) >= self.wanted:
            self.state, self.reason = "RUNNING", ""
        elif pending:
            self.state = "DEGRADED"
            self.reason = (
                f"{len(ready)} of {self.wanted} workers: {len(pending)} wait for a CPU, and none is free; "
                f"add a node, or scale to {len(ready)}"
            )
        else:
            trouble = f"; the last trouble: {self._last_trouble}" if self._last_trouble else ""
            self.state = "DEGRADED"
            self.reason = f"{len(ready)} of {self.wanted} workers: the others are starting{trouble}"

    def _fail(self, reason: str) -> None:
        self.state, self.reason = "FAILED", reason

    def _tell(self, now: float) -> None:
        if self._control.due(now, self.state):
            self._control.publish(self.status(now))

    def wait(self, who: str, whom: str, begins: bool) -> None:
        """Note that somebody begins or ends to wait for somebody."""
        if begins:
            self._waits.setdefault(f"{who} waits for {whom}", self._clock())
        else:
            self._waits.pop(f"{who} waits for {whom}", None)

    def status(self, now: float) -> dict[str, Any]:
        """Everything that `t6gps status` shows; ages in seconds."""
        idle_s = [now - worker.since_s for worker in self.workers.values() if worker.phase == "idle"]
        waits = [{"what": what, "for_s": round(now - since_s, 3)} for what, since_s in self._waits.items()]
        if idle_s and not self.ledger.waiting:
            waits.append({"what": f"{len(idle_s)} workers wait for plans", "for_s": round(min(idle_s), 3)})
        return {
            "state": self.state,
            "reason": self.reason,
            "phase": self.phase,
            "wanted": self.wanted,
            "ready": sum(worker.phase != "starting" and not worker.draining for worker in self.workers.values()),
            "workers": [worker.status(now) for worker in self.workers.values()],
            "backlog": self.ledger.backlog,
            "leases": len(self.ledger.leases),
            "arrived": self.ledger.arrived,
            "bytes_in_flight": (len(self.ledger.leases) + self.ledger.arrived) * self._largest_bytes,
            "waits": waits,
            "quarantined": sorted(self.ledger.quarantined),
            "episodes": dict(self.ledger.counters),
            "processes": dict(self.counters),
        }

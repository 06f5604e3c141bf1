"""The ledger of the episodes being sampled: executed at least once, committed exactly once.

    planned -> leased (slot, incarnation) -> arrived -> committed
       ^          |                             |
       +----------+   given back, failed        +-> dropped and counted when nobody waits for it any more
                  +-> quarantined after three failures of its own

Committed means durable in the spool. The ledger knows neither processes nor the time: `pool` finds out which leases
have outlived their deadline.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

from t6gps.service.pool.attempt import Failure, FailureKind
from t6gps.storage.records import EpisodePlan

FAILURES_ALLOWED_N, ATTEMPTS_ALLOWED_N = 3, 10
"""An episode is quarantined when it has failed so often, or was tried in vain so often: an attempt that is lost with
its process or its node counts only as the latter, for ten in a row in the same episode are no accident."""
HOPELESS_N, HOPELESS_LATER_N = 5, 20
"""Quarantined episodes in a row that mean that nothing works, before and after a first one was committed."""
COUNTERS = ("committed", "duplicates", "late", "expired", "given_back", "lost", "failures", "quarantined")


@dataclass(frozen=True)
class Lease:
    """A plan in the hands of a worker."""

    plan: EpisodePlan
    slot: int
    incarnation: int


@dataclass
class Ledger:
    """What is planned, leased, arrived, committed and quarantined.

    counters               of the whole run, by COUNTERS; part of every checkpoint
    failures               of the batch, by episode
    queue                  plans that nobody has leased
    leases, unkept         leases by episode, before and after it came back
    quarantined_in_a_row   episodes, since one was committed;   `worked` says whether one ever was
    """

    counters: dict[str, int] = field(default_factory=lambda: dict.fromkeys(COUNTERS, 0))
    failures: dict[int, list[Failure]] = field(default_factory=dict)
    quarantined: set[int] = field(default_factory=set)
    queue: deque[EpisodePlan] = field(default_factory=deque)
    leases: dict[int, Lease] = field(default_factory=dict)
    unkept: dict[int, Lease] = field(default_factory=dict)
    committed: set[int] = field(default_factory=set)
    quarantined_in_a_row: int = 0
    worked: bool = False

    def open(self, plans: Sequence[EpisodePlan], quarantined: Iterable[int] = ()) -> None:
        """Begin a new batch; `quarantined` episodes are not tried. What comes of other plans than these is late."""
        self.quarantined = set(quarantined)
        self.failures.clear()
        missing = {plan.episode_id: plan for plan in plans if plan.episode_id not in self.quarantined}
        self.leases = {n: lease for n, lease in self.leases.items() if missing.get(n) == lease.plan}
        self.queue = deque(plan for n, plan in missing.items() if n not in self.leases)
        self.unkept.clear()
        self.committed.clear()

    @property
    def backlog(self) -> int:
        """Episodes that are neither committed nor quarantined."""
        return len(self.queue) + len(self.leases) + len(self.unkept)

    @property
    def waiting(self) -> int:
        """Episodes that nobody has leased."""
        return len(self.queue)

    @property
    def arrived(self) -> int:
        """Episodes that came back and are not committed yet."""
        return len(self.unkept)

    def lease_of(self, episode_id: int) -> Lease | None:
        """The lease under which an episode came back that is not committed yet."""
        return self.unkept.get(episode_id)

    @property
    def hopeless(self) -> bool:
        """True when nothing but failures comes back."""
        if self.worked:
            return self.quarantined_in_a_row >= HOPELESS_LATER_N
        return self.quarantined_in_a_row >= HOPELESS_N or (self.quarantined_in_a_row > 0 and not self.backlog)

    def lease(self, slot: int, incarnation: int) -> EpisodePlan | None:
        """The next plan for a worker, None when there is none."""
        if not self.queue:
            return None
        plan = self.queue.popleft()
        self.leases[plan.episode_id] = Lease(plan, slot, incarnation)
        return plan

    def arrive(self, plan: EpisodePlan) -> bool:
        """An episode came back, from whomever. False, and counted, when it is a duplicate or late: drop it."""
        number = plan.episode_id
        lease = self.leases.get(number)
        if lease is not None and lease.plan == plan:
            self.unkept[number] = self.leases.pop(number)
        elif plan in self.queue:  # the lease was given up too early; its result is as good as any
            self.queue.remove(plan)
            self.unkept[number] = Lease(plan, -1, -1)
        else:
            known = number in self.committed or (number in self.unkept and self.unkept[number].plan == plan)
            self.counters["duplicates" if known else "late"] += 1
            return False
        return True

    def commit(self, episode_id: int) -> None:
        """The episode is durable."""
        del self.unkept[episode_id]
        self.committed.add(episode_id)
        self.quarantined_in_a_row, self.worked = 0, True
        self.counters["committed"] += 1

    def give_back(self, slot: int, incarnation: int, keep: int | None = None) -> list[EpisodePlan]:
        """Return a worker's leases, but for `keep`, to the head of the queue; the plans that were returned."""
        returned = [
            lease
            for lease in self.leases.values()
            if (lease.slot, lease.incarnation) == (slot, incarnation) and lease.plan.episode_id != keep
        ]
        for lease in reversed(returned):
            del self.leases[lease.plan.episode_id]
            self.queue.appendleft(lease.plan)
        self.counters["given_back"] += len(returned)
        return [lease.plan for lease in returned]

    def fail(self, plan: EpisodePlan, failure: Failure) -> bool:
        """An attempt failed or was lost. The plan goes back to the queue; True when it is quarantined now."""
        self.counters["lost" if failure.kind is FailureKind.LOST else "failures"] += 1
        self.counters["expired"] += failure.kind is FailureKind.HANG
        lease = self.leases.get(plan.episode_id)
        if lease is None or lease.plan != plan:
            return False  # somebody else has it by now
        del self.leases[plan.episode_id]
        history = self.failures.setdefault(plan.episode_id, [])
        history.append(failure)
        own_n = sum(failure.kind is not FailureKind.LOST for failure in history)
        if own_n < FAILURES_ALLOWED_N and len(history) < ATTEMPTS_ALLOWED_N:
            self.queue.appendleft(plan)
            return False
        self.quarantined.add(plan.episode_id)
        self.counters["quarantined"] += 1
        self.quarantined_in_a_row += 1
        return True

    def hangs_n(self, plan: EpisodePlan) -> int:
        """Attempts of a plan of this batch that were ended because they took too long."""
        return sum(failure.kind is FailureKind.HANG for failure in self.failures.get(plan.episode_id, ()))

    def state(self) -> dict[str, Any]:
        """What a resumed run needs: the counters. Which episodes are missing stands in spool and bundles."""
        return {"counters": dict(self.counters)}

    def restore(self, state: Any) -> None:
        """Continue from `state()`; nothing changes for a checkpoint that has none."""
        if state is None:
            return
        self.counters |= {name: int(state["counters"].get(name, 0)) for name in COUNTERS}

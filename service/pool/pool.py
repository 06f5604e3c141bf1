"""The pool: carries out what the supervisor decides, and hands episodes to the run."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence

from t6gps.service.pool import messages
from t6gps.service.pool.attempt import Failure
from t6gps.service.pool.decision_log import DecisionLog
from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.outside import Outside, Phases, Situation
from t6gps.service.pool.state import Ending, PoolState, RunState, WorkerId
from t6gps.service.pool.supervisor import decide
from t6gps.service.pool.transport import Done, Transport
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan

TICK_S = 0.1
"""How often a pool looks when nothing comes."""
PAUSE_S = 2.0
"""A pool looks ten times a second. One that did not for so long stood still, with its process or its machine."""


class Pool:
    """Keeps the workers of a run at work on the plans of one batch after another.

    state       what the supervisor knows
    phases      what the run does at present, and how long it did what, for its status
    ticked_s    when the last round began (s, `clock`)
    quarantine  keeps a crash bundle; called with a plan whose last attempt has failed
    """

    def __init__(
        self,
        state: PoolState,
        transport: Transport,
        outside: Outside,
        quarantine: Callable[[EpisodePlan], None],
        log: DecisionLog | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.state, self.phases, self.ticked_s = state, Phases(clock), float("-inf")
        self._transport, self._outside, self._quarantine = transport, outside, quarantine
        self._log, self._clock = log, clock
        self._unseen: list[Observation] = []
        self._came: dict[tuple[WorkerId, int], Episode] = {}
        self._accepted: deque[tuple[int, Episode]] = deque()
        self._waits: dict[str, float] = {}
        self._durable_s: float | None = None

    def tick(self, wait_s: float = 0.0) -> None:
        """One round: observe, decide, carry out. Waits up to `wait_s` for news, which are for the next round.

        RunError when the run cannot continue (`supervisor.decide`).
        """
        self._listen(0.0)
        before_s, self.ticked_s = self.ticked_s, self._clock()
        if PAUSE_S < self.ticked_s - before_s < math.inf:
            self._unseen.append(messages.Paused())
        self._unseen += self._outside.asked()
        self._decide()
        self._outside.told(self.situation())
        if self.state.condition is RunState.FAILED:
            raise RunError(self.state.reason)
        if wait_s > 0:
            self._listen(wait_s)

    def open(self, plans: Sequence[EpisodePlan], quarantined: Sequence[int], policy_digests: Mapping[int, str]) -> None:
        """Begin a batch; what comes of other plans than these is late."""
        self._accepted.clear()
        self.phases.enter("sampling")
        self._unseen.append(messages.Opened(tuple(plans), tuple(quarantined), policy_digests, self.state.ledger.worked))
        self._decide()

    def sample(self, keep: Callable[[Episode], None]) -> None:
        """Let the workers run the batch until no episode is missing; see `deliver` for `keep`."""
        while self.state.ledger.backlog:
            self.tick(0.0 if self._accepted else TICK_S)
            self.deliver(keep)
        if self.state.ledger.hopeless:
            self.tick()

    def deliver(self, keep: Callable[[Episode], None]) -> None:
        """Hand over the episodes that are there; when `keep` returns, one is durable."""
        while self._accepted:
            episode_id, episode = self._accepted.popleft()
            keep(episode)
            self._durable_s = self._clock()
            self._unseen.append(messages.Durable(episode_id))
            self._decide()

    def close(self, condition: RunState, reason: str) -> None:
        """End every worker and say how the run ended."""
        if self._log is not None:
            self._log.close()
        for worker in self.state.workers.values():
            self._transport.kill(worker.id)
        self.state.workers.clear()
        if self.state.condition is not RunState.FAILED:
            self.state.turn(condition, reason)
        self._outside.ended(self.situation())

    def wait(self, who: str, whom: str, begins: bool) -> None:
        """Note that somebody begins or ends to wait for somebody."""
        if begins:
            self._waits.setdefault(f"{who} waits for {whom}", self._clock())
        else:
            self._waits.pop(f"{who} waits for {whom}", None)

    def situation(self) -> Situation:
        """How the pool is, for whoever tells others."""
        at, spent_s = self.phases.at, self.phases.spent_s()
        return Situation(self.state, at, spent_s, self._waits, self._durable_s, self._clock())

    def _listen(self, wait_s: float) -> None:
        """Take what the transport reports; episodes stay here, the supervisor sees their size."""
        for report in self._transport.poll(wait_s):
            self._unseen.append(self._taken(report) if isinstance(report, Done) else report)

    def _taken(self, done: Done) -> Observation:
        """What the supervisor sees of an attempt that is over."""
        worker, plan, result, digest, at_s = done.worker, done.plan, done.result, done.policy_digest, done.at_s
        if result is None:
            return messages.Unserved(worker, plan, at_s)
        if isinstance(result, Failure):
            return messages.Failed(worker, plan, result, digest, at_s)
        self._came[worker, plan.episode_id] = result
        return messages.Sampled(worker, plan, result.nbytes, digest, at_s)

    def _decide(self) -> None:
        """Decide and carry out, until nothing new follows from it."""
        first = True
        while first or self._unseen:
            first, observed, now = False, self._unseen, self._clock()
            self._unseen = []
            if self._log is not None:
                self._log.before(self.state)
            decided = decide(self.state, observed, now)
            if self._log is not None:
                self._log.after(self.state, now, observed, decided)
            self._outside.decided(self.situation(), observed, decided)
            for instruction in decided:
                self._carry_out(instruction)
        self._came.clear()

    def _carry_out(self, instruction: Instruction) -> None:
        match instruction:
            case messages.Start():
                self._transport.start(instruction.worker)
            case messages.Send():
                self._transport.send(instruction.worker, instruction.plan)
            case messages.Ping():
                self._transport.ping(instruction.worker)
            case messages.End():
                drained = instruction.why is Ending.DRAINED
                post_mortem = messages.PostMortem() if drained else self._transport.examine(instruction.worker)
                self._transport.kill(instruction.worker)
                self._unseen.append(messages.Ended(instruction.worker, post_mortem))
            case messages.AskCapacity():
                waiting = tuple(worker for worker in instruction.starting if not self._transport.placed(worker))
                self._unseen.append(messages.Capacity(self._transport.free_workers(), waiting))
            case messages.AskNodes():
                self._transport.ask_nodes(instruction.workers)
            case messages.Accept():
                episode = self._came.pop((instruction.worker, instruction.episode_id))
                self._accepted.append((instruction.episode_id, episode))
            case messages.Quarantine():
                self._quarantine(instruction.plan)
            case messages.Publish():
                self._outside.told(self.situation(), at_once=True)

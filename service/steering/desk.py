"""Where a running run is steered from outside: its pool is told of requests, and its folder tells how it is."""

from __future__ import annotations

import logging
from collections.abc import Sequence

from t6gps.service.pool import messages
from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.outside import Outside, Situation
from t6gps.service.steering import events, status
from t6gps.service.steering.events import EventKind, EventLog, Standing
from t6gps.service.steering.requests import Inbox, What
from t6gps.service.steering.status import PUBLISH_S
from t6gps.storage.catalog import Run

TROUBLE = (EventKind.WAITING, EventKind.CRASH, EventKind.HANG)
"""Events that are warnings in the log. Quarantine and failure have lines of their own."""
_log = logging.getLogger(__name__)


class Desk(Outside):
    """Of a run that may have `workers_most` workers."""

    def __init__(self, run: Run, workers_most: int) -> None:
        self._run, self._most = run, workers_most
        self._inbox, self._events = Inbox(run), EventLog(run.pool)
        self._standing: Standing | None = None
        self._published_s, self._request_id = float("-inf"), ""

    def asked(self) -> list[Observation]:
        request = self._inbox.new()
        if request is None or request.what is What.STOP:  # `watch` heeds that, also where there is no pool
            return []
        self._request_id, self._published_s = request.id, float("-inf")  # answered at once
        if request.what is What.UNPAUSE:
            return [messages.UnpauseRequested()]
        return [messages.ScaleRequested(min(max(request.workers or 0, 0), self._most))]

    def decided(self, situation: Situation, observed: Sequence[Observation], decided: Sequence[Instruction]) -> None:
        if observed or decided or self._standing is None or situation.state.wanted != self._standing.wanted:
            self._write(situation, observed, decided)

    def told(self, situation: Situation, at_once: bool = False) -> None:
        if at_once or situation.now_s - self._published_s >= PUBLISH_S:
            self._published_s = situation.now_s
            status.publish(self._run, status.describe(situation, self._request_id or None, self._most))

    def ended(self, situation: Situation) -> None:
        self._write(situation, (), ())
        self.told(situation, at_once=True)

    def _write(self, situation: Situation, observed: Sequence[Observation], decided: Sequence[Instruction]) -> None:
        before, after = self._standing or Standing(situation.state.wanted), events.standing(situation.state)
        happened = events.of(before, after, situation.state, observed, decided)
        self._standing = after
        self._events.write(happened, situation.phase)
        for each in happened:
            level = logging.WARNING if each.event in TROUBLE else logging.INFO
            _log.log(level, "%s: %s", each.event, each.reason, extra={"slot": each.slot, "episode": each.episode})
        for failed in observed:
            if isinstance(failed, messages.Failed):
                where = {"slot": failed.worker.slot, "episode": failed.plan.episode_id}
                _log.warning(
                    "worker %s: episode %d: %s", failed.worker, failed.plan.episode_id, failed.failure, extra=where
                )

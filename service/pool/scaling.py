"""How many workers a run shall have: as asked for by hand, or by backlog and room."""

from __future__ import annotations

import math

from t6gps.service.pool.messages import AskCapacity
from t6gps.service.pool.state import PoolState, Worker, WorkerPhase

PLANS_PER_WORKER = 2
"""One in hand and one waiting, so that no worker is idle between two episodes."""


def ask_capacity(state: PoolState, now: float) -> list[AskCapacity]:
    """Ask for room, now and then, while somebody waits for a CPU or the pool scales by itself."""
    starting = [worker for worker in state.workers.values() if worker.phase is WorkerPhase.STARTING]
    fresh = state.asked_s is not None and now - state.asked_s < state.timings.capacity_s
    if fresh or not (starting or state.autoscale):
        return []
    state.asked_s = now
    late = [worker.id for worker in starting if now - worker.since_s >= state.timings.pending_after_s]
    return [AskCapacity(tuple(late))]


def autoscale(state: PoolState, now: float) -> None:
    """Move `wanted` between its bounds: up at once, down when workers were not needed for a while."""
    if state.autoscale is None:
        return
    least, most = state.autoscale
    room = sum(not pending(state, worker) for worker in state.workers.values()) + max(state.free_n, 0)
    useful = min(most, max(least, min(room, math.ceil(state.ledger.backlog / PLANS_PER_WORKER))))
    if useful >= state.wanted:
        state.wanted, state.needed_s = useful, now
    elif state.needed_s is None or now - state.needed_s > state.timings.shrink_after_s:
        state.wanted = useful


def pending(state: PoolState, worker: Worker) -> bool:
    """True while a worker waits for a CPU."""
    return worker.phase is WorkerPhase.STARTING and not worker.placed and state.free_n < 1

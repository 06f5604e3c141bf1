"""How many workers a run shall have: as asked for by hand, or by backlog and room; and the room that it asks for."""

from __future__ import annotations

import math

from t6gps.service.pool.messages import AskCapacity, AskNodes
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
    least, _ = state.autoscale
    room = sum(not pending(state, worker) for worker in state.workers.values()) + max(state.free_n, 0)
    useful = min(_useful(state, *state.autoscale), max(least, room))
    if useful >= state.wanted:
        state.wanted, state.needed_s = useful, now
    elif state.needed_s is None or now - state.needed_s > state.timings.shrink_after_s:
        state.wanted = useful


def ask_nodes(state: PoolState) -> list[AskNodes]:
    """Ask for room for as many workers as were of use, and for those that there are; when that number changes."""
    useful = 0 if state.autoscale is None else max(_useful(state, *state.autoscale), state.wanted)
    if useful == state.asked_n:
        return []
    state.asked_n = useful
    return [AskNodes(useful)]


def _useful(state: PoolState, least: int, most: int) -> int:
    """Workers that the backlog would keep at work, were there room."""
    return min(most, max(least, math.ceil(state.ledger.backlog / PLANS_PER_WORKER)))


def pending(state: PoolState, worker: Worker) -> bool:
    """True while a worker waits for a CPU."""
    return worker.phase is WorkerPhase.STARTING and not worker.placed and state.free_n < 1

"""The supervisor of a run's workers: what to do, given what was observed. It reads no clock and touches no process.

`decide` is a function of the state, the observations and the time; `pool` carries its instructions out. A worker is a
slot with an incarnation. However one goes - crash, hang, failed start, lost node, scale-down - it goes by `_end`: what
it held goes back to the ledger, and the slot is filled again if it is wanted. Slots that keep failing wait twice as
long each time; when no worker can start at all, the breaker opens and the run ends with the reason.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

from t6gps.service import provenance
from t6gps.service.pool import messages, scaling
from t6gps.service.pool.attempt import Failure, FailureKind
from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.scaling import PLANS_PER_WORKER
from t6gps.service.pool.state import Ending, Identity, PoolState, RunState, Slot, Worker, WorkerId, WorkerPhase
from t6gps.storage.records import EpisodePlan

BREAKER_N = 5
"""Starts in a row that fail, with no worker left, until the breaker opens."""
GRACE_S = 1.0
"""After a pause of the supervisor itself, what workers did meanwhile is still on its way: nobody is late yet."""


def decide(state: PoolState, observed: Sequence[Observation], now: float) -> list[Instruction]:
    """Bring what is towards what is asked for: change `state` by what was observed, and say what to do.

    The state's condition is FAILED when the run cannot continue: the breaker is open, nothing but failures comes back,
    or a worker has other settings or another policy than the run.
    """
    instructions = [instruction for observation in observed for instruction in _observe(state, observation, now)]
    instructions += scaling.ask_capacity(state, now)
    scaling.autoscale(state, now)
    instructions += scaling.ask_nodes(state)
    for step in (_end_overdue, _drain, _fill, _send):
        instructions += step(state, now)
    before = state.condition, state.reason
    _update_condition(state)
    if (state.condition, state.reason) != before:
        instructions.append(messages.Publish(state.condition, state.reason))
    return instructions


def _observe(state: PoolState, observation: Observation, now: float) -> Iterator[Instruction]:
    match observation:
        case messages.Opened():
            state.policy_digests = dict(observation.policy_digests)
            state.ledger.open(observation.plans, observation.quarantined)
            state.ledger.worked = observation.worked
        case messages.Durable():
            state.ledger.commit(observation.episode_id)
        case messages.Capacity():
            state.free_n = observation.free_n
            for each in state.workers.values():
                each.placed = each.id not in observation.waiting
        case messages.Paused():
            state.judges_from_s = now + GRACE_S
        case messages.ScaleRequested():
            if observation.workers or state.wanted:
                state.before_pause = None if observation.workers else (state.wanted, state.autoscale)
            state.wanted, state.autoscale = observation.workers, None  # scaled by hand: it stays so
        case messages.UnpauseRequested():
            if state.before_pause is not None:
                state.wanted, state.autoscale = state.before_pause
                state.before_pause = None
        case messages.Ended():
            yield from _on_ended(state, observation.worker, observation.post_mortem)
        case _:
            worker = state.worker(observation.worker)
            if worker is not None:
                yield from _on_report(state, worker, observation, now)


def _on_report(state: PoolState, worker: Worker, report: Observation, now: float) -> Iterator[Instruction]:
    match report:
        case messages.Ready():
            if why := _unlike(state, report.identity):
                _fail(state, f"worker {worker.id} on node {report.identity.node} {why}")
                return
            worker.identity, worker.since_s = report.identity, now
            worker.enter(WorkerPhase.IDLE)
            state.failed_starts_n = 0
        case messages.Alive():
            worker.answered = True
        case messages.Died():
            yield _end(state, worker, now, Ending.CRASH, report.error, report.message)
        case messages.Unserved():
            _on_result(state, worker, report.plan, report.at_s)
            state.ledger.give_back(*worker.id)
            worker.plans.clear()
            _begin_episode(state, worker, report.at_s)
        case messages.Failed() if _acted_as_planned(state, worker, report.plan, report.policy_digest):
            _on_result(state, worker, report.plan, report.at_s)
            yield from _record_failure(state, report.plan, report.failure)
        case messages.Sampled() if _acted_as_planned(state, worker, report.plan, report.policy_digest):
            state.times.add(_on_result(state, worker, report.plan, report.at_s), report.plan.steps)
            state.slots[worker.id.slot].failures_n = 0
            state.largest_bytes = max(state.largest_bytes, report.nbytes)
            if state.ledger.arrive(report.plan):
                yield messages.Accept(worker.id, report.plan.episode_id)


def _unlike(state: PoolState, found: Identity) -> str:
    """What a worker has otherwise than the run, in words; empty where it has nothing."""
    others = provenance.differences(found.build, state.build)
    if others:
        return f"has another installation than the run: {others}; install the same on every node"
    if found.settings_digest != state.settings_digest:
        return "has other settings than the run; install the same version on every node"
    return ""


def _on_result(state: PoolState, worker: Worker, plan: EpisodePlan, at_s: float) -> float:
    """A worker was done with a plan then and came to the next; how long it took (s)."""
    took_s = at_s - worker.since_s
    if plan in worker.plans:
        worker.plans.remove(plan)
    _begin_episode(state, worker, at_s)
    return took_s


def _begin_episode(state: PoolState, worker: Worker, at_s: float) -> None:
    """The worker comes to the first of its plans then, if it has one."""
    worker.since_s, worker.answered, worker.deadline_s = at_s, True, None
    if not worker.plans:
        worker.enter(WorkerPhase.IDLE)
        return
    if worker.phase is WorkerPhase.IDLE:
        worker.enter(WorkerPhase.SAMPLING)
    plan = worker.plans[0]
    worker.deadline_s = at_s + state.times.deadline_s(plan.steps) * 2 ** state.ledger.hangs_n(plan)


def _acted_as_planned(state: PoolState, worker: Worker, plan: EpisodePlan, policy_digest: str) -> bool:
    if policy_digest == state.policy_digests.get(plan.policy_version, policy_digest):
        return True
    _fail(
        state,
        f"worker {worker.id} acted with another policy than version {plan.policy_version} of the run; "
        "its data are not kept: resume with --resume, and report this",
    )
    return False


def _record_failure(state: PoolState, plan: EpisodePlan, failure: Failure) -> Iterator[Instruction]:
    state.last_trouble = f"episode {plan.episode_id}: {failure}"
    if state.ledger.fail(plan, failure):
        yield messages.Quarantine(plan)


def _end(state: PoolState, worker: Worker, now: float, why: Ending, error: str = "", message: str = "") -> messages.End:
    """The one way in which a worker goes, planned (drained) or not."""
    if why is not Ending.DRAINED:
        state.slots[worker.id.slot].failed(now, f"{error}: {message}")
        state.last_trouble = f"worker {worker.id}: {error}: {message}"
        state.failed_starts_n += worker.phase is WorkerPhase.STARTING
    else:
        state.slots[worker.id.slot].trouble = ""
    state.counters[why] += 1
    worker.ending = why, error, message
    worker.enter(WorkerPhase.ENDING)
    return messages.End(worker.id, why)


def _on_ended(state: PoolState, worker_id: WorkerId, post_mortem: messages.PostMortem) -> Iterator[Instruction]:
    """The worker is gone: blame the episode in hand if it is at fault, and give back the others."""
    worker = state.workers.pop(worker_id.slot)
    assert worker.id == worker_id and worker.ending is not None, "only a worker that is to end is ended"
    why, error, message = worker.ending
    if why is not Ending.DRAINED and worker.plans:
        plan = worker.plans[0]
        kind = FailureKind.HANG if why is Ending.HANG else FailureKind.CRASH
        kind = kind if post_mortem.episode_at_fault else FailureKind.LOST
        where = f"{worker.id}" + (f", process {worker.identity.pid}" if worker.identity else "")
        failure = Failure(kind, error, message, plan.seed, None, post_mortem.stacks, [], where, post_mortem.log)
        yield from _record_failure(state, plan, failure)
    state.ledger.give_back(*worker_id)


def _end_overdue(state: PoolState, now: float) -> Iterator[Instruction]:
    """Workers that hang by their deadline, and the question for a sign of life to those that are idle."""
    timings = state.timings
    if state.judges_from_s is not None and now < state.judges_from_s:
        return
    for worker in state.workers.values():
        for_s, pinged_s = now - worker.since_s, max(worker.pinged_s or worker.since_s, worker.since_s)
        silent_s = now - pinged_s
        if worker.phase is WorkerPhase.ENDING:
            continue
        if worker.deadline_s is not None and now > worker.deadline_s:
            yield _end(state, worker, now, Ending.HANG, "Hang", f"no result within {for_s:.1f} s")
        elif worker.phase is WorkerPhase.STARTING:
            if for_s > timings.start_s and not scaling.pending(state, worker):
                yield _end(state, worker, now, Ending.HANG, "Hang", f"not ready {for_s:.1f} s after its start")
        elif worker.phase is WorkerPhase.IDLE:
            if not worker.answered and silent_s > timings.ping_deadline_s:
                yield _end(state, worker, now, Ending.HANG, "Hang", f"no sign of life for {silent_s:.1f} s")
            elif worker.answered and silent_s > timings.ping_s:
                worker.pinged_s, worker.answered = now, False
                yield messages.Ping(worker.id)


def _drain(state: PoolState, now: float) -> Iterator[Instruction]:
    """Workers too many finish the episode in hand; others get their next one."""
    for worker in state.workers.values():
        if worker.phase is WorkerPhase.ENDING:
            continue
        if worker.id.slot < state.wanted:
            if worker.phase is WorkerPhase.DRAINING:
                worker.enter(WorkerPhase.SAMPLING)
            continue
        in_hand = worker.plans[0] if worker.plans else None
        if in_hand is None or in_hand.episode_id not in state.ledger.leases:
            yield _end(state, worker, now, Ending.DRAINED)
            continue
        worker.enter(WorkerPhase.DRAINING)
        if len(worker.plans) > 1:  # this worker is gone before it comes to them
            state.ledger.give_back(*worker.id, keep=in_hand.episode_id)
            worker.plans = deque([in_hand])


def _fill(state: PoolState, now: float) -> Iterator[Instruction]:
    for number in range(state.wanted):
        slot = state.slots.setdefault(number, Slot())
        if number in state.workers or (slot.retry_s is not None and slot.retry_s > now):
            continue
        slot.incarnations_n += 1
        worker = WorkerId(number, slot.incarnations_n)
        state.workers[number] = Worker(worker, now)
        state.free_n -= 1
        state.counters["started"] += 1
        yield messages.Start(worker)


def _send(state: PoolState, now: float) -> Iterator[Instruction]:
    for _ in range(PLANS_PER_WORKER):
        for worker in state.workers.values():
            if not worker.ready or len(worker.plans) >= PLANS_PER_WORKER or not _credit(state):
                continue
            plan = state.ledger.lease(*worker.id)
            if plan is None:
                return
            worker.plans.append(plan)
            if len(worker.plans) == 1:
                _begin_episode(state, worker, now)
            yield messages.Send(worker.id, plan)


def _credit(state: PoolState) -> bool:
    """True while another episode may be under way: what has arrived and is not durable yet counts."""
    under_way = len(state.ledger.leases) + state.ledger.arrived
    most_bytes_n = max(state.bytes_in_flight // state.largest_bytes, 1)
    return under_way < min(PLANS_PER_WORKER * max(len(state.workers), 1), most_bytes_n)


def _update_condition(state: PoolState) -> None:
    """Condition and reason, in words."""
    if state.condition is RunState.FAILED:
        return
    ready_n = sum(worker.phase not in (WorkerPhase.STARTING, WorkerPhase.ENDING) for worker in state.workers.values())
    pending_n = sum(scaling.pending(state, worker) for worker in state.workers.values())
    few = f"{ready_n} of {state.wanted} workers"
    if state.ledger.hopeless:
        _fail(state, f"nothing but failures comes back; the last: {state.last_trouble}; replay its bundle")
    elif state.failed_starts_n >= BREAKER_N and not ready_n:
        _fail(
            state,
            f"{state.failed_starts_n} workers in a row could not start; the last: {state.last_trouble}; "
            "mend the cause, then resume with --resume",
        )
    elif state.wanted == 0:
        state.turn(RunState.PAUSED, "scaled to no workers; t6gps unpause or t6gps scale continues it")
    elif ready_n >= state.wanted:
        state.turn(RunState.RUNNING, "")
    elif pending_n:
        remedy = f"add a node, or scale to {ready_n}"
        state.turn(RunState.DEGRADED, f"{few}: {pending_n} wait for a CPU, and none is free; {remedy}")
    else:
        trouble = f"; the last trouble: {state.last_trouble}" if state.last_trouble else ""
        state.turn(RunState.DEGRADED, f"{few}: the others are starting{trouble}")


def _fail(state: PoolState, reason: str) -> None:
    state.turn(RunState.FAILED, reason)

"""The workers, the learner and the holder of the weights as Ray actors: the one file that knows Ray.

Workers pull: a worker asks the holder for a policy when a plan names another than it has. Tables travel through the
object store and are read in place. Ray restarts nothing: `pool` replaces workers, the transport replaces the holder,
`run` replaces the learner.
"""

from __future__ import annotations

import logging
import math
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import ray
from ray._private import services
from ray._private import worker as ray_worker
from ray._private.state import actors

from t6gps.service import control, processes
from t6gps.service.config import WORKERS_MOST_N, Config
from t6gps.service.control import Control
from t6gps.service.executor import Executor
from t6gps.service.pool import Pool
from t6gps.service.processes import Process
from t6gps.service.sampler import Failure, Runner, attempt, policy_digest, settings_digest
from t6gps.service.transport import Alive, Died, Done, Identity, Ready, Remains, Report, Transport
from t6gps.storage.catalog import Run
from t6gps.storage.errors import LearnerDiedError, RunError, T6GpsError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings
from t6gps.workers.worker import RolloutWorker

MakeWorker = Callable[[RolloutSettings], Runner]
OBJECT_STORE_BYTES = 2 * 1024**3
PULL_DEADLINE_S = 10.0
HOLDER_PING_S, HOLDER_START_S = 0.5, 60.0
"""How often the holder is asked for a sign of life, and how long its process may take to start and give one."""
VERSIONS_HELD_N = 2
_log = logging.getLogger(__name__)


class HolderActor:
    """Holds the newest weights for whoever asks."""

    def __init__(self) -> None:
        self._held: dict[int, PolicySnapshot] = {}

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Take a policy, and forget all but the last ones."""
        self._held[snapshot.version] = snapshot
        for version in sorted(self._held)[:-VERSIONS_HELD_N]:
            del self._held[version]

    def version(self, version: int) -> PolicySnapshot | None:
        """The policy of that version, None when it is not held."""
        return self._held.get(version)

    def ping(self) -> int:
        """Newest version held; -1 for none."""
        return max(self._held, default=-1)


class WorkerActor:
    """A worker in a process of its own, which pulls the policy that its plan names."""

    def __init__(self) -> None:
        self._process = processes.dump_stacks_on_signal()
        self._worker: Runner | None = None
        self._snapshot: PolicySnapshot | None = None
        self._digest = ""

    def open(self, make_worker: MakeWorker, settings: RolloutSettings) -> tuple[Identity, Process, str]:
        """Make the worker; who it is, its process, and the node in Ray's words."""
        self._worker = make_worker(settings)
        identity = Identity(os.getpid(), socket.gethostname(), settings_digest(settings.model_dump_json()))
        return identity, self._process, ray.get_runtime_context().get_node_id()

    def ping(self) -> None:
        """A sign of life."""

    def run(self, plan: EpisodePlan, holder: Any) -> tuple[pa.Table | Failure | None, pa.Table | None, str]:
        """Summary, frames and the policy's digest; a Failure, or None without the policy, in the summary's place."""
        if self._worker is None:
            raise RunError("a worker must be opened before it runs plans")
        if self._snapshot is None or self._snapshot.version != plan.policy_version:
            try:
                self._snapshot = ray.get(holder.version.remote(plan.policy_version), timeout=PULL_DEADLINE_S)
            except ray.exceptions.RayError:
                return None, None, ""  # the holder has died; its successor will be named with the next plan
            if self._snapshot is None:
                return None, None, ""
            self._digest = policy_digest(self._snapshot)
        result = attempt(self._worker, plan, self._snapshot)
        if isinstance(result, Failure):
            return result, None, self._digest
        return result.summary, result.frames, self._digest


class LearnerActor:
    """The learner; its fits run as tasks beside it."""

    def __init__(self, config: Config) -> None:
        from t6gps.service.serial import new_learner  # it loads torch, and the other actors live in this module too

        self._learner = new_learner(config, fit_map=_task_map(config.run.workers))

    def add(self, frames: pa.Table) -> None:
        self._learner.add(frames)

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        yield from getattr(self._learner, phase)()

    def ask(self, method: str, *arguments: Any) -> Any:
        return getattr(self._learner, method)(*arguments)


def _get(reference: Any) -> Any:
    """The value behind a reference. An error of this package comes as itself, the death of a process as RunError."""
    try:
        return ray.get(reference)
    except ray.exceptions.RayTaskError as error:
        if isinstance(error.cause, T6GpsError):
            raise error.cause from error
        raise
    except ray.exceptions.RayError as error:
        raise RunError(
            f"a process of the run died ({type(error).__name__}); everything sampled so far is kept: go on with "
            "--resume, and with fewer --workers if memory ran out"
        ) from error


def _how(error: Exception) -> str:
    """How a process ended, without Ray's guesses at why."""
    text = " ".join(str(error).split()).partition(" Some common causes")[0]
    return text.partition("Worker exit type: ")[2] or text


def _as_given(host: str) -> str:
    return host


def _to_log(data: dict[str, Any], ignore_prefix: bool) -> None:
    """What Ray would print among the results on stdout, such as the death of a worker that the pool replaces."""
    _log.info("ray: %s", " ".join(data["lines"]))


def _start(plain: type, *arguments: Any, cpus: float = 0) -> Any:
    """A handle to an actor made from a plain class. Ray restarts none: what an actor held would be lost unnoticed."""
    return ray.remote(num_cpus=cpus, max_restarts=0)(plain).remote(*arguments)


def _task_map(width: int) -> Callable[..., Iterator[Any]]:
    """A `map` that runs up to `width` calls at once as Ray tasks and yields their results in order.

    The tasks claim no CPU: the workers, which hold the CPUs, are idle while the learner works.
    """

    def task_map(function: Callable[[Any], Any], jobs: Sequence[Any]) -> Iterator[Any]:
        task = ray.remote(num_cpus=0, max_retries=3)(function)
        pending: list[Any] = []
        for job in jobs:
            pending.append(task.remote(job))
            if len(pending) == width:
                yield _get(pending.pop(0))
        for result in pending:
            yield _get(result)

    return task_map


class _Remote:
    """A worker as the transport knows it: its actor, and its process once it is ready."""

    def __init__(self, actor: Any) -> None:
        self.actor = actor
        self.process: Process | None = None
        self.node = ""


class RayTransport(Transport):
    """Workers as actors, and the holder of the weights, which is replaced from a backup when it dies."""

    def __init__(self, make_worker: MakeWorker, settings: RolloutSettings, cpus_per_worker: float) -> None:
        self._make_worker, self._settings, self._cpus = make_worker, settings, cpus_per_worker
        self._node = ray.get_runtime_context().get_node_id()
        self._logs = Path(ray_worker._global_node.get_logs_dir_path())  # type: ignore[attr-defined]
        self._asked: dict[Any, tuple[_Remote, EpisodePlan | None, Any]] = {}
        self._held: dict[int, PolicySnapshot] = {}
        self._holder = _start(HolderActor)
        self._holder_pong: Any = None
        self._holder_pinged_s = 0.0
        self.holders_n = 1

    def publish(self, snapshot: PolicySnapshot) -> None:
        """Give the holder the newest policy, and keep it in case the holder dies. RunError for an older one."""
        newest = max(self._held, default=snapshot.version)
        if snapshot.version < newest:
            raise RunError(f"policy versions only grow: version {newest} is published, found {snapshot.version}")
        self._held[snapshot.version] = snapshot
        for version in sorted(self._held)[:-VERSIONS_HELD_N]:
            del self._held[version]
        try:
            ray.get(self._holder.publish.remote(snapshot), timeout=HOLDER_START_S)
        except ray.exceptions.RayError:
            self._replace_holder()

    def start(self, slot: int, incarnation: int) -> _Remote:
        remote = _Remote(_start(WorkerActor, cpus=self._cpus))
        self._asked[remote.actor.open.remote(self._make_worker, self._settings)] = remote, None, "open"
        return remote

    def send(self, handle: _Remote, plan: EpisodePlan) -> None:
        summary, frames, digest = handle.actor.run.options(num_returns=3).remote(plan, self._holder)
        self._asked[digest] = handle, plan, (summary, frames)

    def ping(self, handle: _Remote) -> None:
        self._asked[handle.actor.ping.remote()] = handle, None, "ping"

    def poll(self, wait_s: float) -> list[Report]:
        self._watch_holder()
        if not self._asked:
            time.sleep(wait_s)
            return []
        found, _ = ray.wait(list(self._asked), num_returns=1, timeout=wait_s)
        if found:
            found, _ = ray.wait(list(self._asked), num_returns=len(self._asked), timeout=0)
        return [self._report(reference, *self._asked.pop(reference)) for reference in found]

    def _report(self, reference: Any, remote: _Remote, plan: EpisodePlan | None, what: Any) -> Report:
        try:
            answer = ray.get(reference)
            if plan is not None:
                summary, frames = what
                result = ray.get(summary)
                if isinstance(result, pa.Table):
                    result = Episode(ray.get(frames), result)
                return Done(remote, plan, result, answer, frames)
        except ray.exceptions.RayTaskError as error:
            cause = error.cause if isinstance(error.cause, Exception) else error
            return Died(remote, type(cause).__name__, str(cause))
        except ray.exceptions.RayError as error:
            return Died(remote, type(error).__name__, _how(error))
        if what == "ping":
            return Alive(remote)
        identity, remote.process, remote.node = answer
        return Ready(remote, identity)

    def examine(self, handle: _Remote) -> Remains:
        if handle.process is None:
            return Remains("the process was never ready")
        if handle.node != self._node:
            return Remains(f"the process is on another node ({handle.node})")
        return Remains(processes.stacks(handle.process), processes.log_tail(self._logs, handle.process.pid))

    def kill(self, handle: _Remote) -> None:
        ray.kill(handle.actor)
        if handle.process is not None and handle.node == self._node:
            processes.kill(handle.process)  # a stopped process does not hear Ray
        self._asked = {key: value for key, value in self._asked.items() if value[0] is not handle}

    def placed(self, handle: _Remote) -> bool:
        known = actors(handle.actor._actor_id.hex())
        return bool(known) and known["State"] not in ("DEPENDENCIES_UNREADY", "PENDING_CREATION")

    def free_workers(self) -> int:
        free: dict[str, float] = ray.available_resources()  # type: ignore[no-untyped-call]
        return int(free.get("CPU", 0.0) / self._cpus + 1e-6)

    def _watch_holder(self) -> None:
        now = time.monotonic()
        if self._holder_pong is None:
            if now - self._holder_pinged_s >= HOLDER_PING_S:
                self._holder_pong, self._holder_pinged_s = self._holder.ping.remote(), now
            return
        answered, _ = ray.wait([self._holder_pong], timeout=0)
        if answered:
            try:
                ray.get(self._holder_pong)
                self._holder_pong = None
            except ray.exceptions.RayError:
                self._replace_holder()
        elif now - self._holder_pinged_s > HOLDER_START_S:
            self._replace_holder()

    def _replace_holder(self) -> None:
        _log.warning("the holder of the weights has died; another one takes its place")
        ray.kill(self._holder)
        self._holder = _start(HolderActor)
        for version in sorted(self._held):
            self._holder.publish.remote(self._held[version])
        self._holder_pong, self._holder_pinged_s = None, time.monotonic()
        self.holders_n += 1


class RayExecutor(Executor):
    """Workers, learner and weights as actors on Ray.

    Joins the cluster that RAY_ADDRESS names; without it, starts an embedded one on the loopback address with
    a token of its own (`t6gps.service`).
    """

    def __init__(self, config: Config, run: Run | None = None, make_worker: MakeWorker = RolloutWorker) -> None:
        super().__init__(config, run)
        most = _join_or_start(config)
        self._transport = RayTransport(make_worker, config.rollout, config.run.cpus_per_worker)
        self.pool = Pool(
            self._transport,
            self.ledger,
            config.run.workers,
            settings_digest(config.rollout.model_dump_json()),
            Control(run, most),
            self._quarantine,
            autoscale=config.run.autoscale,
        )
        self._learner: Any = None
        self._newest: tuple[Episode, Any] | None = None  # an episode and the reference to its frames
        self._tended_s = -math.inf
        self._tend()

    def sample(
        self, plans: Sequence[EpisodePlan], snapshot: PolicySnapshot, purpose: str = "episode"
    ) -> Iterator[Episode]:
        self._open(plans, snapshot, purpose)
        self._transport.publish(snapshot)
        self.pool.open({version: policy_digest(held) for version, held in self._snapshots.items()})
        for episode, frames in self.pool.arrivals():
            self._newest = episode, frames
            yield episode
        self._newest = None

    def add(self, episode: Episode) -> None:
        # The frames of an episode that has just been sampled are in the object store already.
        frames = episode.frames
        if self._newest is not None and self._newest[0] is episode:
            frames = self._newest[1]
        self._answer(self._of_learner.add.remote(frames))

    def learn(self, phase: str) -> Iterator[tuple[int, int]]:
        self.pool.phase = phase
        steps = self._of_learner.learn.options(num_returns="streaming").remote(phase)
        while True:
            self._await(steps)
            try:
                step = next(steps)
            except StopIteration:
                return
            yield self._answer(step)

    def ask(self, method: str, *arguments: Any) -> Any:
        return self._answer(self._of_learner.ask.remote(method, *arguments))

    def replace_learner(self) -> None:
        if self._learner is not None:
            ray.kill(self._learner)
        self._learner = None

    def close(self) -> None:
        if not ray.is_initialized():
            return
        # A second Ctrl-C must not leave half of the processes behind.
        previous = {number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            self.pool.close(*(("DONE", "") if self.finished else ("STOPPING", "the run was stopped")))
        finally:
            ray.shutdown()
            for number, handler in previous.items():
                signal.signal(number, handler)

    @property
    def _of_learner(self) -> Any:
        """The learner's actor, started when it is first needed."""
        if self._learner is None:
            self._learner = _start(LearnerActor, self.config)
        return self._learner

    def _answer(self, reference: Any) -> Any:
        """What the learner answers; the pool is tended meanwhile. LearnerDiedError when its process is gone."""
        self._await(reference)
        try:
            return _get(reference)
        except RunError as error:
            if isinstance(error.__cause__, ray.exceptions.ActorDiedError | ray.exceptions.ActorUnavailableError):
                raise LearnerDiedError(f"the learner's process died: {error.__cause__}") from error
            raise

    def _await(self, reference: Any) -> None:
        self.pool.wait("the run", "the learner", True)
        while not ray.wait([reference], timeout=control.TICK_S)[0]:
            self._tend()
        self.pool.wait("the run", "the learner", False)
        self._tend()

    def _tend(self) -> None:
        """Let the pool work, but not all the time."""
        if time.monotonic() - self._tended_s >= control.TICK_S:
            self.pool.tick()
            self._tended_s = time.monotonic()


def _join_or_start(config: Config) -> int:
    """Join the cluster of RAY_ADDRESS or start an embedded one; the largest number of workers that may be wished."""
    ray_worker.print_to_stdstream = _to_log
    if "RAY_ADDRESS" in os.environ:
        _init()
        return WORKERS_MOST_N  # nodes may join later
    # The address below would be replaced by that of the host, and the ports opened to its network.
    services.resolve_ip_for_localhost = _as_given
    each = config.run.cpus_per_worker
    workers_n = max(config.run.workers, *(config.run.autoscale or (0,)))
    cpus_n = max(math.ceil(workers_n * each), os.cpu_count() or 1)
    _init(
        address="local",
        num_cpus=cpus_n,
        include_dashboard=False,
        object_store_memory=OBJECT_STORE_BYTES,
        logging_level=logging.ERROR,
        _node_ip_address="127.0.0.1",
    )
    return int(cpus_n / each + 1e-6)


def _init(**options: Any) -> None:
    """Start or join Ray. RunError when that fails."""
    try:
        ray.init(log_to_driver=False, **options)
    except Exception as error:  # Ray has no narrower one for this
        ray.shutdown()
        where = os.environ.get("RAY_ADDRESS", "on this machine")
        raise RunError(
            f"Ray could not be started or joined ({where}): {' '.join(str(error).split())}; check RAY_ADDRESS and the "
            "token, try again when the machine is less busy, or use --serial"
        ) from error

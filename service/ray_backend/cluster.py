"""Joining a cluster of Ray, or starting one on this machine, and where in it what runs.

Whatever the run cannot do without - the learner, the policy server - runs on the node of the supervising process: it is
lost with that node alone. Workers are spread over all nodes.
"""

from __future__ import annotations

import math
import os
import secrets
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeAlias

import ray
from ray.autoscaler.sdk import request_resources
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from t6gps.service import caller, checks, machine
from t6gps.service.checks import Wanted
from t6gps.service.config import WORKERS_MOST_N, Config
from t6gps.service.logs import Speaker
from t6gps.service.ray_backend import private, starting
from t6gps.storage.errors import RunError

STARTING = "Ray could not be started on this machine", "end other programs if it is busy, or ask t6gps doctor"
JOINING = (
    "the cluster at RAY_ADDRESS={} could not be joined",
    "see that a head of Ray listens there, and is not busy",
)
REMEDIES = {
    "ersion mismatch": "install the same versions of Ray and Python on every machine",
    "Could not find any running Ray": "start its head (ray start --head), or unset RAY_ADDRESS",
    "uthenticat": "give its token (RAY_AUTH_MODE=token and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH)",
}
"""By words of the error or of its causes: Ray has no types for them."""
SPREAD = "SPREAD"
Actor: TypeAlias = Any
"""A handle to an actor: Ray makes the methods of it."""
Reference: TypeAlias = Any
"""Where a value lies, or will lie, in Ray's object store."""


def embedded_environment() -> dict[str, str]:
    """Variables for the processes of an embedded Ray, which reads its settings from them.

    It talks only to processes that know its token. Whoever has set one of them keeps it.
    """
    return {
        "RAY_AUTH_MODE": "token",
        "RAY_AUTH_TOKEN": secrets.token_hex(32),
        # Ray would run the workers at the lowest priority but four: on a busy machine they hardly start.
        "RAY_worker_niceness": "0",
        "RAY_task_events_report_interval_ms": "0",  # nobody asks for the history of calls
        "RAY_memory_monitor_refresh_ms": "1000",  # four times a second costs a thousandth of a core
        # Processes that fit models wait for the next iteration. Ray would end them after a second, and a new one takes
        # longer to start than the fits take.
        "RAY_idle_worker_killing_time_threshold_ms": "300000",
        "PYTHONOPTIMIZE": "",  # Ray's own processes need their docstrings
    } | {name: value for name, value in os.environ.items() if name.startswith("RAY_") and name != "RAY_ADDRESS"}


@contextmanager
def connection(config: Config) -> Iterator[int]:
    """Ray for the time of a run; the largest number of workers that may be asked for.

    The Ray that this process is connected to is used, and left running at the end. Else the cluster of RAY_ADDRESS is
    joined; without that, an embedded Ray is started. Its settings and its token reach its processes through environment
    variables (`embedded_environment`), which are set while it starts and put back before this function yields.
    RunError when it cannot be joined or started.
    """
    if ray.is_initialized():
        yield WORKERS_MOST_N
        return
    with private.adapted(), machine.all_descriptors(), ExitStack() as connected:
        try:
            with caller.untouched():
                most = _join_or_start(config, connected)
        except RunError:
            private.read_authentication()  # of the caller's environment
            raise
        yield most


def _join_or_start(config: Config, connected: ExitStack) -> int:
    each = config.run.cpus_per_worker
    workers_n = max(config.run.workers, *(config.run.autoscale or (0,)))
    address = checks.cluster_address()
    if address is not None:
        checks.require(checks.CLUSTER, Wanted(workers_n))
        _enter(connected, JOINING[0].format(address), JOINING[1], {})
        return WORKERS_MOST_N  # nodes may join later
    checks.require(checks.OWN_RAY, Wanted(workers_n))
    folder = machine.temporary_folder()
    assert folder is not None, "the checks have found one"
    store = machine.object_store(folder)
    os.environ.update(embedded_environment())
    cpus_n = max(math.ceil(workers_n * each), os.cpu_count() or 1)
    options = {
        "address": "local",
        "num_cpus": cpus_n,
        "include_dashboard": False,
        "object_store_memory": store.nbytes,
        "_plasma_directory": str(store.folder),
        "_temp_dir": str(folder),
        "_node_ip_address": "127.0.0.1",
    }
    _enter(connected, *STARTING, options)
    return int(cpus_n / each + 1e-6)


def start_actor(plain: type, speaker: Speaker, *arguments: Any, cpus: float = 0, where: str = SPREAD) -> Actor:
    """A handle to an actor made from a plain class, on the node `where` (or spread over all), that logs as `speaker`.

    Ray restarts none: what an actor held would be lost unnoticed.
    """
    place: Any = where if where == SPREAD else NodeAffinitySchedulingStrategy(where, soft=False)
    return ray.remote(num_cpus=cpus, max_restarts=0, scheduling_strategy=place)(plain).remote(speaker, *arguments)


def this_node() -> str:
    """The node of this process, in Ray's words."""
    name: str = ray.get_runtime_context().get_node_id()
    return name


def free_workers(cpus_per_worker: float) -> int:
    """Workers that still find room: what is left on one node is of no use to a worker on another."""
    return sum(int(free / cpus_per_worker + 1e-6) for free in private.free_cpus_by_node())


def ask_nodes(workers: int, cpus_per_worker: float) -> None:
    """Let an autoscaler of Ray, where the cluster has one, keep room for so many workers on all nodes together.

    It heeds the last call. Nodes that nobody uses or asks for go after its own time.
    """
    request_resources(bundles=[{"CPU": cpus_per_worker}] * workers)


def _enter(connected: ExitStack, trouble: str, remedy: str, options: dict[str, Any]) -> None:
    """Start or join Ray until the end of `connected`. RunError when that fails, with a known remedy or this one."""
    try:
        connected.enter_context(starting.started(options | {"job_config": private.without_working_folder()}))
    except Exception as error:  # Ray has no narrower one for this
        causes = f"{error} {error.__cause__}"
        known = next((helps for words, helps in REMEDIES.items() if words in causes), remedy)
        raise RunError(f"{trouble}: {' '.join(str(error).split())}; {known}") from error

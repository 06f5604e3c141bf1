"""Joining a cluster of Ray, or starting one on this machine, and where in it what runs.

Whatever the run cannot do without - the learner, the policy server - runs on the node of the supervising process: it is
lost with that node alone. Workers are spread over all nodes.
"""

from __future__ import annotations

import logging
import math
import os
import secrets
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from t6gps.service import caller
from t6gps.service.config import WORKERS_MOST_N, Config
from t6gps.service.ray_backend import private
from t6gps.storage.errors import RunError

OBJECT_STORE_BYTES = 2 * 1024**3
CONNECT_DEADLINE_S = 10.0
"""How long the head of a cluster has to answer."""
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
    } | {name: value for name, value in os.environ.items() if name.startswith("RAY_")}


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
    with private.adapted():
        try:
            with caller.untouched():
                most = _join_or_start(config)
            yield most
        finally:
            with caller.untouched():
                ray.shutdown()
            private.read_authentication()


def _join_or_start(config: Config) -> int:
    if "RAY_ADDRESS" in os.environ:
        _join(os.environ["RAY_ADDRESS"])
        return WORKERS_MOST_N  # nodes may join later
    os.environ.update(embedded_environment())
    each = config.run.cpus_per_worker
    workers_n = max(config.run.workers, *(config.run.autoscale or (0,)))
    cpus_n = max(math.ceil(workers_n * each), os.cpu_count() or 1)
    _init(
        "Ray could not be started on this machine",
        "try again when the machine is less busy, or use --serial",
        address="local",
        num_cpus=cpus_n,
        include_dashboard=False,
        object_store_memory=OBJECT_STORE_BYTES,
        _node_ip_address="127.0.0.1",
    )
    return int(cpus_n / each + 1e-6)


def start_actor(plain: type, *arguments: Any, cpus: float = 0, where: str = SPREAD) -> Actor:
    """A handle to an actor made from a plain class, on the node `where` (or spread over all).

    Ray restarts none: what an actor held would be lost unnoticed.
    """
    place: Any = where if where == SPREAD else NodeAffinitySchedulingStrategy(where, soft=False)
    return ray.remote(num_cpus=cpus, max_restarts=0, scheduling_strategy=place)(plain).remote(*arguments)


def this_node() -> str:
    """The node of this process, in Ray's words."""
    name: str = ray.get_runtime_context().get_node_id()
    return name


def free_workers(cpus_per_worker: float) -> int:
    """Workers that still find room: what is left on one node is of no use to a worker on another."""
    return sum(int(free / cpus_per_worker + 1e-6) for free in private.free_cpus_by_node())


def _join(address: str) -> None:
    """Join a cluster. RunError at once when nobody listens there, where Ray would try for minutes."""
    if address != "auto":
        host, colon, port = address.rpartition(":")
        if not (colon and host and port.isdecimal()) or "://" in address:
            raise RunError(f"RAY_ADDRESS must be HOST:PORT of a cluster's head, or auto, found {address!r}; correct it")
        try:
            socket.create_connection((host.strip("[]"), int(port)), CONNECT_DEADLINE_S).close()
        except (OSError, OverflowError) as error:
            raise RunError(
                f"no Ray answers at RAY_ADDRESS={address} ({error}); start its head (ray start --head), correct the "
                "address, or unset it to use this machine alone"
            ) from None
    _init(
        f"the cluster at RAY_ADDRESS={address} could not be joined",
        "give its token (RAY_AUTH_MODE=token and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH) and the same version of Ray",
    )


def _init(trouble: str, remedy: str, **options: Any) -> None:
    """Start or join Ray. RunError when that fails."""
    private.read_authentication()
    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:  # Ray has no narrower one for this
        raise RunError(f"{trouble}: {' '.join(str(error).split())}; {remedy}") from error

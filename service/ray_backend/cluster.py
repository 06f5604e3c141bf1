"""Joining a cluster of Ray, or starting one on this machine, and where in it what runs.

Whatever the run cannot do without - the learner, the policy server - runs on the node of the supervising process: it is
lost with that node alone. Workers are spread over all nodes.
"""

from __future__ import annotations

import logging
import math
import os
import socket
from typing import Any

import ray
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from t6gps.service.config import WORKERS_MOST_N, Config
from t6gps.service.ray_backend import private
from t6gps.storage.errors import RunError

OBJECT_STORE_BYTES = 2 * 1024**3
CONNECT_DEADLINE_S = 10.0
"""How long the head of a cluster has to answer."""
SPREAD = "SPREAD"


def join_or_start(config: Config) -> int:
    """Join the cluster of RAY_ADDRESS or start an embedded one; the largest number of workers that may be wished.

    RunError when that fails.
    """
    private.prepare_start()
    if "RAY_ADDRESS" in os.environ:
        _join(os.environ["RAY_ADDRESS"])
        return WORKERS_MOST_N  # nodes may join later
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


def start_actor(plain: type, *arguments: Any, cpus: float = 0, where: str = SPREAD) -> Any:
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
    """So many more workers find room: what is left on one node is of no use to a worker on another."""
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
    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
    except Exception as error:  # Ray has no narrower one for this
        ray.shutdown()
        raise RunError(f"{trouble}: {' '.join(str(error).split())}; {remedy}") from error

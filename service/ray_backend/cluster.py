"""Joining a cluster of Ray, or starting one on this machine, and where in it what runs.

Whatever the run cannot go on without - the learner, the weights - runs on the node of the supervising process: it is
lost with that node alone. Workers are spread over all nodes.
"""

from __future__ import annotations

import logging
import math
import os
import socket
from typing import Any

import ray
from ray._private import services
from ray._private import worker as ray_worker
from ray._private.state import available_resources_per_node
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from t6gps.service.config import WORKERS_MOST_N, Config
from t6gps.storage.errors import RunError

OBJECT_STORE_BYTES = 2 * 1024**3
CONNECT_DEADLINE_S = 10.0
"""How long the head of a cluster has to answer."""
SPREAD = "SPREAD"
_log = logging.getLogger(__name__)


def join_or_start(config: Config) -> int:
    """Join the cluster of RAY_ADDRESS or start an embedded one; the largest number of workers that may be wished.

    RunError when that fails.
    """
    ray_worker.print_to_stdstream = _to_log
    # A loopback address would be replaced by that of the host: ports opened to its network, a cluster not found.
    services.resolve_ip_for_localhost = _as_given
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
    node: Any = ray_worker._global_node
    for unused in (node.kill_log_monitor, node.kill_monitor, node.kill_dashboard):  # logs to forward, nodes to start
        unused(check_alive=False)
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
    nodes: dict[str, dict[str, float]] = available_resources_per_node()  # type: ignore[no-untyped-call]
    return sum(int(free.get("CPU", 0.0) / cpus_per_worker + 1e-6) for free in nodes.values())


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


def _as_given(host: str) -> str:
    return host


def _to_log(data: dict[str, Any], ignore_prefix: bool) -> None:
    """What Ray would print among the results on stdout, such as the death of a worker that the pool replaces."""
    _log.info("ray: %s", " ".join(data["lines"]))

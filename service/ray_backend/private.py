"""Everything that is used of Ray beyond its public names.

What Ray does not offer otherwise: which nodes have room, whether an actor has found one, where logs are, an embedded
Ray that listens on the loopback address alone, its token, workers that do not import from the working folder, and a
standard output without its messages. The tests of
tests/faults run through each name; whoever takes another version of Ray begins with this page.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ray._private import node, services
from ray._private import worker as ray_worker
from ray._private.authentication.http_token_authentication import get_auth_headers_if_auth_enabled
from ray._private.state import actors, available_resources_per_node
from ray._raylet import AuthenticationTokenLoader, Config, wait_for_persisted_port  # type: ignore[attr-defined]
from ray.job_config import JobConfig

PORT_WAIT_MS, PORT_LOOK_S = 30_000, 0.02
_WAITING = ("DEPENDENCIES_UNREADY", "PENDING_CREATION")
_log = logging.getLogger(__name__)


@contextmanager
def adapted() -> Iterator[None]:
    """Let Ray use addresses as they are given, print nothing, and not keep others from running, until the end.

    Ray would replace a loopback address by that of the host: ports open to its network, a cluster that is not found.
    Its messages, such as the death of a worker that the pool replaces, would stand among the results. While it waits
    for its first process, it would hold the interpreter's lock for half a minute, and nobody would hear a signal.
    """
    adaptations = (
        (services, "resolve_ip_for_localhost", _as_given),
        (ray_worker, "print_to_stdstream", _to_log),
        (node, "wait_for_persisted_port", _wait_for_port),
    )
    kept = [(module, name, getattr(module, name)) for module, name, _ in adaptations]
    for module, name, function in adaptations:
        setattr(module, name, function)
    try:
        yield
    finally:
        for module, name, function in kept:
            setattr(module, name, function)


def read_authentication() -> None:
    """Let Ray read mode and token from the environment again: it does so once, and somebody may have used it before."""
    Config.initialize("")
    AuthenticationTokenLoader.instance().reset_cache()


def authentication_headers() -> dict[str, str]:
    """What a request by HTTP carries to a cluster with a token; nothing where no token is in use."""
    headers: dict[str, str] = get_auth_headers_if_auth_enabled({})
    return headers


def without_working_folder() -> JobConfig:
    """A job whose workers do not look for modules in this process's working folder, where any file may lie.

    Ray leaves it out for jobs of its own client, and knows no other way that copies nothing.
    """
    return JobConfig(_client_job=True)


def logs_folder() -> Path:
    """Where the processes of this node write their logs."""
    return Path(ray_worker._global_node.get_logs_dir_path())  # type: ignore[attr-defined]


def is_placed(actor: Any) -> bool:
    """False while no node has room for an actor."""
    known = actors(actor._actor_id.hex())
    return bool(known) and known["State"] not in _WAITING


def free_cpus_by_node() -> list[float]:
    """CPUs that nobody has claimed, one number per node."""
    nodes: dict[str, dict[str, float]] = available_resources_per_node()  # type: ignore[no-untyped-call]
    return [free.get("CPU", 0.0) for free in nodes.values()]


def _as_given(host: str) -> str:
    return host


def _wait_for_port(session: str, node_id: str, name: str, timeout_ms: int = PORT_WAIT_MS) -> int:
    """As `wait_for_persisted_port`, which waits in C: many short waits in the place of a long one."""
    deadline_s = time.monotonic() + timeout_ms / 1000
    while True:
        try:
            port: int = wait_for_persisted_port(session, node_id, name, timeout_ms=0)
            return port
        except RuntimeError:
            if time.monotonic() > deadline_s:
                raise
        time.sleep(PORT_LOOK_S)


def _to_log(data: dict[str, Any], ignore_prefix: bool) -> None:
    _log.info("ray: %s", " ".join(data["lines"]))

"""Everything that is used of Ray beyond its public names.

What Ray does not offer otherwise: which nodes have room, whether an actor has found one, where logs are, an embedded
Ray that listens on the loopback address alone, its token, and a standard output without its messages. The tests of
tests/faults run through each name; whoever takes another version of Ray begins with this page.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ray._private import services
from ray._private import worker as ray_worker
from ray._private.state import actors, available_resources_per_node
from ray._raylet import AuthenticationTokenLoader, Config  # type: ignore[attr-defined]

_WAITING = ("DEPENDENCIES_UNREADY", "PENDING_CREATION")
_log = logging.getLogger(__name__)


@contextmanager
def adapted() -> Iterator[None]:
    """Let Ray use addresses as they are given, and print nothing, until the end.

    Ray would replace a loopback address by that of the host: ports open to its network, a cluster that is not found.
    Its messages, such as the death of a worker that the pool replaces, would stand among the results.
    """
    kept = services.resolve_ip_for_localhost, ray_worker.print_to_stdstream
    services.resolve_ip_for_localhost, ray_worker.print_to_stdstream = _as_given, _to_log
    try:
        yield
    finally:
        services.resolve_ip_for_localhost, ray_worker.print_to_stdstream = kept


def read_authentication() -> None:
    """Let Ray read mode and token from the environment again: it does so once, and somebody may have used it before."""
    Config.initialize("")
    AuthenticationTokenLoader.instance().reset_cache()


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


def _to_log(data: dict[str, Any], ignore_prefix: bool) -> None:
    _log.info("ray: %s", " ".join(data["lines"]))

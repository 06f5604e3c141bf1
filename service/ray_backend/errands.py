"""Errands on a cluster: short jobs that look at its nodes and its root for somebody who sees neither.

    python -m t6gps.service.ray_backend.errands NAME ARGUMENT...

Each prints a line `result: ...` in JSON; or one line `error: ...`, and ends with exit code 2.
"""

from __future__ import annotations

import logging
import secrets
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import ray
from pydantic import BaseModel, ConfigDict, TypeAdapter
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from t6gps.service import checks, provenance
from t6gps.service.checks import Wanted
from t6gps.service.ray_backend import cluster, private, starting
from t6gps.service.ray_backend.cluster import Reference
from t6gps.service.ray_backend.jobs_api import RESULT
from t6gps.service.steering import requests
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import Status
from t6gps.storage import catalog, durable
from t6gps.storage.errors import RunError, T6GpsError
from t6gps.storage.objects import publishing
from t6gps.storage.objects.place import whole

NODES_DEADLINE_S = 60.0
"""For an answer of all nodes, each of which starts a process for it."""
JOBS = ".jobs"


class Node(BaseModel):
    """A node of the cluster: its address and CPUs, its installation, whether it sees the root; or what is wrong."""

    model_config = ConfigDict(frozen=True)

    address: str
    cpus: float
    build: dict[str, str] = {}
    sees_root: bool = False
    fault: str = ""


class Survey(BaseModel):
    """A cluster as it is: `head`, the node on which jobs start; the `others`; whether the head sees a given file."""

    model_config = ConfigDict(frozen=True)

    head: Node
    others: tuple[Node, ...]
    sees_file: bool


def look(root: str, file: str) -> Survey:
    """How the nodes are, and what they see of a root. RunError where it cannot hold runs."""
    folder = Path(root)
    checks.require([checks.root_folder], Wanted(0, folder))
    sees_file = Path(file).is_file()
    joined = starting.started({"job_config": private.without_working_folder()})
    sign = folder / f".sign-{secrets.token_hex(8)}"
    with _there(folder, sign), private.adapted(), joined:
        head, *others = _nodes(str(sign))
    return Survey(head=head, others=tuple(others), sees_file=sees_file)


@contextmanager
def _there(folder: Path, sign: Path) -> Iterator[None]:
    """A file is there in a folder meanwhile; folders that were made for it go with it, unless somebody uses them."""
    missing = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    sign.touch()
    try:
        yield
    finally:
        sign.unlink()
        with suppress(OSError):
            for path in missing:
                path.rmdir()


def _nodes(sign: str) -> list[Node]:
    """All nodes, that of this process first, each asked for itself; without those that leave meanwhile."""
    here = cluster.this_node()
    alive = sorted(_alive().values(), key=lambda node: node["NodeID"] != here)
    ask = ray.remote(num_cpus=0, max_retries=0)(_found)
    places = [NodeAffinitySchedulingStrategy(node["NodeID"], soft=False) for node in alive]
    answers = [ask.options(scheduling_strategy=place).remote(sign) for place in places]
    ready, _ = ray.wait(answers, num_returns=len(answers), timeout=NODES_DEADLINE_S)
    nodes = {
        node["NodeID"]: _node(node, answer if answer in ready else None)
        for node, answer in zip(alive, answers, strict=True)
    }
    still = _alive()
    return [node for name, node in nodes.items() if name in still or not node.fault]


def _alive() -> dict[str, dict[str, Any]]:
    """What Ray knows of the nodes that it takes for alive, by their names."""
    known: list[dict[str, Any]] = ray.nodes()  # type: ignore[no-untyped-call]
    return {node["NodeID"]: node for node in known if node["Alive"]}


def _node(node: dict[str, Any], answer: Reference | None) -> Node:
    """A node with what it has answered."""
    known = Node(address=node["NodeManagerAddress"], cpus=node["Resources"].get("CPU", 0.0))
    if answer is None:
        return known.model_copy(update={"fault": f"no answer within {NODES_DEADLINE_S:.0f} s"})
    try:
        build, sees_root = ray.get(answer)
    except ray.exceptions.RayError as error:
        return known.model_copy(update={"fault": str(error).strip().splitlines()[-1]})
    return known.model_copy(update={"build": build, "sees_root": sees_root})


def _found(sign: str) -> tuple[dict[str, str], bool]:
    """What a node finds on itself."""
    return provenance.build(), Path(sign).exists()


def place(root: str, again: str, *runs: str) -> list[str]:
    """Bring the jobs' folders from the working folder into the root; where they lie.

    RunError, and nothing changed, where a run or a job is in the way. With `again` the job's folder is replaced.
    """
    jobs = Path(root) / JOBS
    jobs.mkdir(parents=True, exist_ok=True)
    if not again:
        for run in runs:
            taken = next((path for path in (Path(root) / run, jobs / run) if path.exists()), None)
            if taken is not None:
                raise RunError(f"{taken} exists already on the cluster; choose another name with --run")
    for run in runs:
        with durable.draft(jobs / run) as draft:
            shutil.copytree(run, draft, dirs_exist_ok=True)
            durable.sync_tree(draft)
            if (jobs / run).exists():
                durable.discard(jobs / run)
            if not durable.claim(draft, jobs / run):
                raise RunError(f"{jobs / run} was taken just now; choose another name with --run")
    return [str(jobs / run) for run in runs]


def remove(root: str, *runs: str) -> None:
    """Remove jobs' folders whose jobs could not be started."""
    for run in runs:
        durable.discard(Path(root) / JOBS / run)


def publish(root: str, address: str, *runs: str) -> None:
    """See that runs can be published from here, where they train: keys, store, and no other runs of these names there.

    ConfigError without keys, StoreError where the store takes nothing, RunError where it has other runs.
    """
    target = whole(Path(address))
    publishing.probe(target)
    for run in runs:
        publishing.check_same(Path(root) / run, target / run)


def status(root: str, run: str) -> Status | None:
    """As `statuses.begun`."""
    return statuses.begun(Path(root), run)


def scale(root: str, run: str, workers: str, deadline_s: str) -> Status:
    """Give a run workers, as `requests.scale` does."""
    return requests.scale(catalog.open_run(Path(root), run), int(workers), float(deadline_s))


ERRANDS: dict[str, Callable[..., object]] = {
    function.__name__: function for function in (look, place, remove, publish, status, scale)
}


def main(name: str, *arguments: str) -> None:
    """Run an errand and print what it brings."""
    try:
        print(f"{RESULT}{TypeAdapter(object).dump_json(ERRANDS[name](*arguments)).decode()}")
    except T6GpsError as error:
        print(f"error: {' '.join(str(error).split())}")
        sys.exit(2)


if __name__ == "__main__":
    logging.disable(logging.WARNING)
    main(*sys.argv[1:])

"""`python3 -m t6gps.service.launch.targets.errand NAME ROOT RUN ...`: what is asked where a run lies, from elsewhere.

files  ROOT RUN               its files, as {path: [size, sha256]}
status ROOT RUN               its status, null where it has none yet
scale  ROOT RUN N DEADLINE    its status when it has N workers

The answer is JSON. Exit code 2, and why in words, where there is none.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from dataclasses import astuple
from pathlib import Path

from t6gps.service.launch.fetch import FolderSource
from t6gps.service.steering import requests
from t6gps.service.steering import status as statuses
from t6gps.service.steering.status import Status
from t6gps.storage import catalog
from t6gps.storage.errors import T6GpsError


def files(root: str, run: str) -> dict[str, tuple[int, str]]:
    """Size and SHA-256 of each file of a run. RunError where it is used, or is not there."""
    found = FolderSource(catalog.open_run(Path(root), run)).files()
    return {path: astuple(file) for path, file in found.items()}


def status(root: str, run: str) -> Status | None:
    """As `statuses.begun`."""
    return statuses.begun(Path(root), run)


def scale(root: str, run: str, workers: str, deadline_s: str) -> Status:
    """As `requests.scale`."""
    return requests.scale(catalog.open_run(Path(root), run), int(workers), float(deadline_s))


ERRANDS: dict[str, Callable[..., object]] = {"files": files, "status": status, "scale": scale}


def main(name: str, *arguments: str) -> int:
    """Do an errand; its exit code."""
    try:
        answer = ERRANDS[name](*arguments)
    except T6GpsError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    sys.stdout.write(json.dumps(answer))
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

"""How far a run is copied into an object store: RUN/pool/published.json, written by the process that copies."""

from __future__ import annotations

import json

from pydantic import TypeAdapter, ValidationError
from typing_extensions import TypedDict  # pydantic cannot check those of `typing` before Python 3.12

from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.objects import publishing


class Written(TypedDict):
    """Where to, how many iterations are there, and what the last attempt met, None for nothing."""

    to: str
    iterations: int
    error: str | None


class Published(Written):
    """The same, and how many committed iterations are not there yet."""

    behind: int


_WRITTEN = TypeAdapter(Written)


def write(run: Run, written: Written) -> None:
    """Replace what is said of a run, in one step."""
    path = run.pool / "published.json"
    path.parent.mkdir(exist_ok=True)
    durable.replace(path, f"{json.dumps(written)}\n".encode())


def standing(run: Run) -> Published | None:
    """How far a run is copied, None for one that nobody publishes. RunError where that cannot be read."""
    path = run.pool / "published.json"
    try:
        written = _WRITTEN.validate_json(path.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValidationError) as error:
        reason = " ".join(str(error).split())
        raise RunError(f"cannot read {path}: {reason}; resume the run with --publish, which writes it anew") from None
    try:
        committed_n = publishing.iterations(run.path)
    except RunError:  # its newest commit is torn, which who reads its tables is told
        committed_n = written["iterations"]
    return {**written, "behind": max(0, committed_n - written["iterations"])}

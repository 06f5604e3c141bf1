"""Benchmarks by name. Each figure that claims speed is a ratio to a reference measured in the same run."""

from __future__ import annotations

import difflib
import importlib
import subprocess
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from t6gps.storage.errors import ConfigError

BENCHMARKS = {
    "growth": "t6gps.service.bench.learner",
    "learner": "t6gps.service.bench.learner",
    "physics": "t6gps.workers.bench.physics",
    "pool": "t6gps.service.bench.pool",
    "soundness": "t6gps.workers.bench.soundness",
}
"""Module of each benchmark; the function in it has the benchmark's name."""


SIZED = ("pool",)
"""Benchmarks that can be told how long and how often to measure."""


def measure(name: str, **sizes: float) -> dict[str, Any]:
    """Run a benchmark: {"bench", "commit", "threads", "notes", "results": {key: number, None where nothing is}}.

    ConfigError for an unknown name, or for sizes of a benchmark that has none.
    """
    if name not in BENCHMARKS:
        close = difflib.get_close_matches(name, BENCHMARKS, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ConfigError(f"unknown benchmark '{name}'{hint}; allowed: {', '.join(BENCHMARKS)}")
    if sizes and name not in SIZED:
        raise ConfigError(f"bench {name} has no --{' and no --'.join(sizes)}; allowed for: {', '.join(SIZED)}")
    module = importlib.import_module(BENCHMARKS[name])
    run: Callable[..., dict[str, float | None]] = getattr(module, name)
    known = {"threads": getattr(module, "THREADS", 1), "notes": list(getattr(module, "NOTES", ()))}
    return {"bench": name, "commit": commit(), **known, "results": run(**sizes)}


def commit() -> str:
    """The checked-out commit, or the version of an installed package."""
    folder = Path(__file__).parent
    git = subprocess.run(
        ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude", "*"],
        capture_output=True,
        text=True,
        check=False,
    )
    return git.stdout.strip() if git.returncode == 0 else metadata.version("t6gps")

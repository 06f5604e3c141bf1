"""Benchmarks by name. Each figure that claims speed is a ratio to a reference measured in the same run."""

from __future__ import annotations

import difflib
import importlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial

from t6gps.service.bench.rounds import Say
from t6gps.service.provenance import Provenance, provenance
from t6gps.storage.errors import ConfigError

BENCHMARKS = {
    "learner": "t6gps.service.bench.learner",
    "physics": "t6gps.workers.bench.physics",
    "pool": "t6gps.service.bench.pool",
    "scale": "t6gps.service.bench.scale",
    "server": "t6gps.service.bench.server",
    "soundness": "t6gps.workers.bench.soundness",
    "storage": "t6gps.service.bench.stores.storage",
}
"""Module of each benchmark; the function in it has the benchmark's name."""


SIZES = {"pool": ("seconds", "rounds"), "server": ("seconds", "rounds"), "storage": ("rounds",)}
"""Benchmarks that can be told how long or how often to measure."""
LONG = ("learner", "pool", "scale", "server", "storage")
"""Benchmarks that say how far they are."""


@dataclass(frozen=True)
class Measurement:
    """A benchmark's figures and where they come from; `results` are None where there is nothing to measure."""

    bench: str
    provenance: Provenance
    threads: int
    notes: tuple[str, ...]
    results: dict[str, float | None]

    def to_json(self) -> str:
        """One object: the entries of the provenance beside the others."""
        entries = {name: value for name, value in asdict(self).items() if name != "provenance"}
        return json.dumps({**asdict(self.provenance), **entries})


def measure(name: str, say: Say, **sizes: float) -> Measurement:
    """Run a benchmark, which says how far it is.

    ConfigError for an unknown name, or for sizes of a benchmark that has none.
    """
    if name not in BENCHMARKS:
        close = difflib.get_close_matches(name, BENCHMARKS, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ConfigError(f"unknown benchmark '{name}'{hint}; allowed: {', '.join(BENCHMARKS)}")
    unknown = [size for size in sizes if size not in SIZES.get(name, ())]
    if unknown:
        has = [other for other, known in SIZES.items() if unknown[0] in known]
        raise ConfigError(f"bench {name} has no --{' and no --'.join(unknown)}; allowed for: {', '.join(has)}")
    module = importlib.import_module(BENCHMARKS[name])
    run: Callable[..., dict[str, float | None]] = getattr(module, name)
    if name in LONG:
        run = partial(run, say)
    threads, notes = getattr(module, "THREADS", 1), tuple(getattr(module, "NOTES", ()))
    return Measurement(name, provenance(), threads, notes, run(**sizes))

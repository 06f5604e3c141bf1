"""Benchmarks by name. Each figure that claims speed is a ratio to a reference measured in the same run."""

from __future__ import annotations

import difflib
import importlib
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial

from t6gps.service.provenance import Provenance, provenance
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError

BENCHMARKS = {
    "learner": "t6gps.service.bench.learner",
    "physics": "t6gps.workers.bench.physics",
    "policy": "t6gps.service.policies.speed",
    "pool": "t6gps.service.bench.pool",
    "scale": "t6gps.service.bench.scale",
    "server": "t6gps.service.bench.server",
    "soundness": "t6gps.workers.bench.soundness",
    "storage": "t6gps.service.bench.stores.storage",
    "surrogate": "t6gps.service.bench.surrogate.judgement",
}
"""Module of each benchmark; the function in it has the benchmark's name."""


OPTIONS = {
    "pool": ("seconds", "rounds"),
    "server": ("seconds", "rounds"),
    "storage": ("rounds",),
    "surrogate": ("iteration", "pieces", "states", "seed", "overrides"),
}
"""Benchmarks that can be told what or how much to measure, and what they can be told."""
SPELLED = {"overrides": "set"}
"""Options whose name on the command line is another one."""
OF_RUN = ("surrogate",)
"""Benchmarks of a stored run."""
LONG = ("learner", "pool", "scale", "server", "storage", "surrogate")
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


def measure(
    name: str, say: Callable[[str], None], run: Callable[[], Run] | None = None, **options: float | Sequence[str]
) -> Measurement:
    """Run a benchmark, which says how far it is in lines; `run` opens the run that it is to judge.

    ConfigError for an unknown name, for options that the benchmark has not, and for a run too many or missing.
    """
    if name not in BENCHMARKS:
        close = difflib.get_close_matches(name, BENCHMARKS, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        raise ConfigError(f"unknown benchmark '{name}'{hint}; allowed: {', '.join(BENCHMARKS)}")
    for option in options:
        if option not in OPTIONS.get(name, ()):
            having = (benchmark for benchmark, others in OPTIONS.items() if option in others)
            spelled = SPELLED.get(option, option)
            raise ConfigError(f"bench {name} has no --{spelled}; allowed for: {', '.join(having)}")
    if (run is None) == (name in OF_RUN):
        wrong = "needs a run to judge: t6gps bench surrogate RUN" if run is None else "measures no run: leave RUN away"
        raise ConfigError(f"bench {name} {wrong}")
    module = importlib.import_module(BENCHMARKS[name])
    bench: Callable[..., dict[str, float | None]] = getattr(module, name)
    if name in LONG:
        bench = partial(bench, say)
    if run is not None:
        bench = partial(bench, run())
    threads, notes = getattr(module, "THREADS", 1), tuple(getattr(module, "NOTES", ()))
    return Measurement(name, provenance(), threads, notes, bench(**options))

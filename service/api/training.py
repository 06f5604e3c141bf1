"""Training and evaluation from Python.

Neither prints, exits, or changes the environment or the signal handlers of the calling process. While they work in this
process (`serial`), numerical libraries compute with one thread. KeyboardInterrupt, or an error that `progress` raises,
stops everything that was started, keeps everything that was sampled, and comes out as it is.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike, fspath
from pathlib import Path

from t6gps.service import config as configuration
from t6gps.service.api.run import Run
from t6gps.service.training import publishing, session
from t6gps.service.training.evaluation import Evaluation
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError

Row = Mapping[str, int | float | None]
Setting = str | int | float | bool | Sequence[str | int | float]
FINISHED = "finished"
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Progress:
    """How far a run is.

    phase   sample, segment, fit, backward_pass, supervise or evaluate, of which `done` of `total` parts are done; or
            finished, when the iteration is committed
    row     the finished iteration's row of the table `iterations` (docs/data.md); else None
    """

    iteration: int
    phase: str
    done: int
    total: int
    row: Row | None = None


class _Teller:
    """Tells a callable what an observer is told."""

    def __init__(self, tell: Callable[[Progress], object] | None) -> None:
        self._tell = tell

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if self._tell is not None:
            self._tell(Progress(iteration, phase, done, total))

    def finished(self, row: Row) -> None:
        iteration = row["iteration"]
        assert isinstance(iteration, int), "the schema of `iterations` says so"
        if self._tell is not None:
            self._tell(Progress(iteration, FINISHED, 1, 1, row))


def train(
    source: str | PathLike[str],
    *,
    name: str | None = None,
    root: str | PathLike[str] = "runs",
    settings: Mapping[str, Setting] | None = None,
    workers: int | None = None,
    serial: bool = False,
    resume: bool = False,
    publish: str | None = None,
    progress: Callable[[Progress], object] | None = None,
) -> Run:
    """Train a policy and evaluate it without noise; the finished run.

    source     a preset's name or the path of a TOML file
    name       the run's; by default the preset's, followed by a number where that is taken
    root       folder that holds the runs
    settings   dotted keys and values, such as {"run.iterations": 2}
    workers    rollout workers on Ray; they change the speed, never the data
    serial     in this process, without Ray; the same data
    resume     continue the run of that name, with the same settings; start it where it is not there yet
    publish    s3://BUCKET/PREFIX where each iteration is copied to meanwhile, in the store of the AWS_* variables
    progress   called with each `Progress`

    Without `serial`, workers run on the Ray that the caller is connected to, which is left running; else on the cluster
    of RAY_ADDRESS; else on one that is started for the run. ConfigError for a source or a setting that cannot be used,
    RunError for a run that exists, or cannot be started, StoreError where a store takes no copies.
    """
    source, folder = fspath(source), Path(root)
    config = configuration.load(source, _overrides(settings, workers))
    copies = publishing.target(publish)
    run = session.begin(config, folder, name, Path(source).stem, resume, _log.warning, copies)
    session.complete(config, run, serial, _Teller(progress), copies)
    return Run(run.path)


def evaluate(
    run: Run,
    *,
    episodes: int = 40,
    seed: int = 1,
    terrain_seed: int | None = None,
    version: int | None = None,
    keep: bool = True,
    settings: Mapping[str, Setting] | None = None,
    workers: int | None = None,
    serial: bool = False,
    progress: Callable[[Progress], object] | None = None,
) -> Evaluation:
    """Evaluate a policy of a run without noise.

    episodes       at least two
    version        of the policy, the newest by default
    keep           the episodes, in the run's tables `evaluations`, `evaluation_episodes` and `evaluation_frames`
    seed           of starts, waypoints and ground; no training episode shares its random numbers
    terrain_seed   of the ground alone
    settings       another world, such as {"terrain.difficulty": 0.5}

    The rest is as for `train`. ConfigError for a number or a setting that is not allowed, RunError before the first
    checkpoint.
    """
    for what, value, least in (("episodes", episodes, 2), ("seed", seed, 0), ("terrain_seed", terrain_seed or 0, 0)):
        if not isinstance(value, int) or value < least:
            raise ConfigError(f"evaluate takes a whole {what} >= {least}, found {value!r}; give another number")
    folder = catalog.Run(run.path)
    config = session.evaluation_config(folder, _overrides(settings, workers), _log.warning)
    asked = session.Asked(episodes, seed, terrain_seed, version, keep)
    result, _ = session.evaluate(folder, config, asked, serial, session.Engine.BULLET, _Teller(progress))
    return result


def _overrides(settings: Mapping[str, Setting] | None, workers: int | None) -> list[str]:
    """Settings as `configuration.load` takes them: TOML and JSON write such values alike."""
    chosen = dict(settings or {}) | ({} if workers is None else {"run.workers": workers})
    overrides = []
    for key, value in chosen.items():
        try:
            overrides.append(f"{key}={json.dumps(value, ensure_ascii=False)}")
        except TypeError as error:
            raise ConfigError(f"settings[{key!r}]: {error}; use numbers, strings, booleans and lists") from None
    return overrides

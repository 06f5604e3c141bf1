"""A policy that acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from t6gps.learner.port import Manifest
from t6gps.service import config as configuration
from t6gps.service.execution.wiring import new_learner
from t6gps.storage import checkpoint
from t6gps.storage.catalog import Run as Folder
from t6gps.storage.errors import DataError, RunError
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N
from t6gps.workers.episode import policy as acting


@final
@dataclass(frozen=True)
class Policy:
    """The noise-free policy of a version, ready to act.

    snapshot   its weights
    """

    snapshot: PolicySnapshot

    @property
    def version(self) -> int:
        """Iterations of the learner behind it."""
        return self.snapshot.version

    def __call__(self, observation: ArrayLike) -> NDArray[np.float64]:
        """Rest lengths [24] (m) that it commands for an observation [83], both canonical; not clipped to the winches.

        Observations are those of the table `frames` and of the Gymnasium environment (docs/environment.md). DataError
        unless they are 83 finite numbers.
        """
        try:
            values = np.asarray(observation, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise DataError(f"an observation is {OBSERVATION_N} finite numbers, found {error}; convert it") from None
        if values.shape != (OBSERVATION_N,) or not np.isfinite(values).all():
            raise DataError(
                f"an observation is {OBSERVATION_N} finite numbers, found {values.size} of shape {values.shape}, "
                f"{int(np.isfinite(values).sum())} of them finite; give one row at a time"
            )
        return acting.ready(self.snapshot)(values)


def load(run: Folder, version: int | None) -> Policy:
    """The policy of a checkpoint, the newest by default. RunError naming the versions that are kept."""
    if version is None:
        latest = checkpoint.load_latest(run.checkpoints)
        if latest is None:
            raise RunError(f"run {run.name} has no checkpoint yet; let it finish an iteration")
    else:
        kept = checkpoint.kept(run.checkpoints)
        if version not in kept:
            versions = ", ".join(map(str, sorted(kept))) or "none yet"
            raise RunError(f"run {run.name} keeps no policy of version {version!r}; kept: {versions}")
        latest = checkpoint.load(kept[version])
    learner = new_learner(configuration.kept(run))
    learner.restore(cast(Manifest, latest[1]), latest[2])
    return Policy(learner.policy())

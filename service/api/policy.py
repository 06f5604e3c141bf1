"""A policy that acts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from t6gps.storage.errors import DataError
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

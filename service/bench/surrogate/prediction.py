"""The held-out error of the local models: fitted to three quarters of the episodes, judged by the others."""

from __future__ import annotations

import numpy as np

from t6gps.learner.algorithm.features import whole_columns
from t6gps.learner.bench.held_out import held_out
from t6gps.learner.settings import Localization
from t6gps.service.bench.surrogate.agreement import Figures
from t6gps.service.bench.surrogate.stored import Stored
from t6gps.storage.errors import DataError

HELD_OUT_SHARE = 0.25


def prediction_test(stored: Stored, rng: np.random.Generator) -> Figures:
    """R2 of the next reduced state by its parts, and the mean squared error of the next velocity (m2/s2).

    Empty for clusters, which are other ones for every set of episodes. DataError for less than two episodes.
    """
    learner, episodes_n = stored.config.learner, len(stored.episodes)
    if learner.localization is Localization.CLUSTERS:
        return {}
    if episodes_n < 2:
        raise DataError(
            f"iteration {stored.iteration} has one episode, none can be held out; choose another --iteration"
        )
    held_n = max(1, round(HELD_OUT_SHARE * episodes_n))
    chosen = np.isin(stored.episode, rng.choice(episodes_n, held_n, replace=False))
    found = held_out(learner, stored.redone.segmented, stored.config.run.seed, stored.iteration, chosen)
    error = np.square(found.after.astype(np.float64) - found.predicted)
    spread = np.square(found.after - found.after.mean(axis=0, dtype=np.float64))
    figures: Figures = {
        "held_out_episodes": float(held_n),
        "held_out_rows": float(len(found.rows)),
        "held_out_known_share": found.known_share,
    }
    for column, place in whole_columns(learner.reduced_state).items():
        figures[f"held_out_{column}_r2"] = float(1 - error[:, place].sum() / spread[:, place].sum())
    velocity = whole_columns(learner.reduced_state)["com_velocity"]
    figures["held_out_com_velocity_squared_error"] = float(error[:, velocity].mean())
    return figures

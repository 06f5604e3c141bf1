"""Other ways to group samples for local models, to compare with segment classes (paper Sec. III, VI).

KIND       one model bin for the ordinary transitions of each kind of triangle, one for its crossings of each exit
NONE       one bin for everything
CLUSTERS   the bins of KIND divided by k-means on the standardised reduced state, as Reset-Free GPS localises its
           samples (Montgomery et al. 2017): no time, no entry, no order
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import NONE, Rows
from t6gps.learner.algorithm.local_models import FIT_STREAM, ClassJob
from t6gps.learner.algorithm.modes import FitOptions, moments
from t6gps.learner.settings import Localization

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SAMPLES_PER_CLUSTER = 400
"""As many as a step of a common segment class holds."""
LLOYD_ITERATIONS = 15
CLUSTER_STREAM = 3
"""Branch of the learner's seed sequence, after 0 fits, 1 S-step and 2 untrained policy."""


def jobs(
    rows: Rows, localization: Localization, options: FitOptions, run_seed: int, iteration: int
) -> dict[int, ClassJob]:
    """Jobs of the bins, each of a single step; shrunk as the steps of classes are, towards the kind (and exit)."""
    samples, index = rows.samples, np.flatnonzero(rows.continues)
    pools = np.stack([rows.kind[index], rows.exit[index]], axis=1)
    if localization is Localization.NONE:
        pools[:] = NONE
    rng = np.random.default_rng(np.random.SeedSequence(run_seed, spawn_key=(1, iteration, CLUSTER_STREAM)))
    built: dict[int, ClassJob] = {}
    for kind, exit_ in np.unique(pools, axis=0).tolist():
        pool = index[(pools == (kind, exit_)).all(axis=1)]
        prior = moments(samples[pool].astype(np.float64))
        clusters = np.zeros(len(pool), dtype=np.int64)
        if localization is Localization.CLUSTERS:
            clusters = k_means(rows.state[pool].astype(np.float64), -(-len(pool) // SAMPLES_PER_CLUSTER), rng)
        for cluster in np.unique(clusters).tolist():
            chosen = pool[clusters == cluster]
            built[len(built)] = ClassJob(
                rows=chosen,
                samples=samples[chosen],
                state_n=rows.state.shape[1],
                step=np.zeros(len(chosen), dtype=np.int64),
                steps=1,
                crosses=False,
                ordinary=prior,
                crossing=None,
                options=options,
                entropy=run_seed,
                branch=(1, iteration, FIT_STREAM, kind + 1, exit_ + 1, cluster),
            )
    return built


def k_means(points: Array, clusters_n: int, rng: np.random.Generator) -> Ints:
    """Cluster of each point [n] by Lloyd's algorithm on standardised coordinates, from random points as centres."""
    spread = points.std(axis=0)
    points = (points - points.mean(axis=0)) / np.where(spread > 0, spread, 1.0)
    centres = points[rng.choice(len(points), min(clusters_n, len(points)), replace=False)]
    nearest = _nearest(points, centres)
    for _ in range(LLOYD_ITERATIONS):
        counts = np.bincount(nearest, minlength=len(centres))
        sums = np.zeros_like(centres)
        np.add.at(sums, nearest, points)
        centres = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], centres)
        moved, nearest = nearest, _nearest(points, centres)
        if np.array_equal(moved, nearest):
            break
    return nearest


def _nearest(points: Array, centres: Array) -> Ints:
    distances = np.einsum("ki,ki->k", centres, centres) - 2 * points @ centres.T
    nearest: Ints = distances.argmin(axis=1)
    return nearest

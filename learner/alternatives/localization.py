"""Other ways to group samples for local models, to compare with segment classes (paper Sec. III, VI).

KIND       one model bin for the ordinary transitions of each kind of triangle, one for its crossings of each exit
NONE       one bin for everything
CLUSTERS   the bins of KIND divided by k-means on the standardised reduced state, as Reset-Free GPS localises its
           samples (Montgomery et al. 2017): no time, no entry, no order

They stand in the place of lines 4 and 5 of Algorithm 2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from t6gps.learner.algorithm.local_models import ClassPlan
from t6gps.learner.algorithm.modes import FitOptions
from t6gps.learner.algorithm.regression import pooled_moments
from t6gps.learner.rows import NONE, Floats, Ints, Rows
from t6gps.learner.settings import Localization
from t6gps.learner.streams import Stream, branch, generator

SAMPLES_PER_CLUSTER = 400
"""As many as a step of a common segment class holds."""
LLOYD_ITERATIONS = 15


def plans(
    rows: Rows, localization: Localization, options: FitOptions, run_seed: int, iteration: int
) -> dict[int, ClassPlan]:
    """Plans of the bins, each of a single step; shrunk as the steps of classes are, towards the kind (and exit)."""
    index = np.flatnonzero(rows.continues)
    pools = np.stack([rows.kind[index], rows.exit[index]], axis=1)
    if localization is Localization.NONE:
        pools[:] = NONE
    rng = generator(run_seed, branch(iteration, Stream.CLUSTERS))
    made: dict[int, ClassPlan] = {}
    for kind, exit_ in np.unique(pools, axis=0).tolist():
        pool = index[(pools == (kind, exit_)).all(axis=1)]
        prior = pooled_moments(rows, pool)
        clusters = np.zeros(len(pool), dtype=np.int64)
        if localization is Localization.CLUSTERS:
            clusters = k_means(rows.state[pool], -(-len(pool) // SAMPLES_PER_CLUSTER), rng)
        for cluster in np.unique(clusters).tolist():
            chosen = pool[clusters == cluster]
            made[len(made)] = ClassPlan(
                rows=chosen,
                state_n=rows.state.shape[1],
                step=np.zeros(len(chosen), dtype=np.int64),
                steps=1,
                crosses=False,
                ordinary=prior,
                crossing=None,
                options=options,
                run_seed=run_seed,
                branch=branch(iteration, Stream.FITS, kind + 1, exit_ + 1, cluster),
            )
    return made


def k_means(states: Floats, clusters_n: int, rng: np.random.Generator) -> Ints:
    """Cluster of each state [n, nx] by scikit-learn's KMeans on standardised coordinates.

    Centres begin at random states that the generator chooses. One thread: several add up in an order of their own.
    """
    from sklearn.cluster import KMeans
    from threadpoolctl import threadpool_limits

    spread = states.std(axis=0, dtype=np.float64)
    points: NDArray[np.float64] = (states - states.mean(axis=0, dtype=np.float64)) / np.where(spread > 0, spread, 1.0)
    seed = int(rng.integers(2**31))
    search = KMeans(
        min(clusters_n, len(points)), init="random", n_init=1, max_iter=LLOYD_ITERATIONS, tol=0.0, random_state=seed
    )
    with threadpool_limits(limits=1):
        labels: Ints = search.fit_predict(points).astype(np.int64)
    return labels

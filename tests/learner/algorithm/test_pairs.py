"""Laws of pairs: what is taken of them are rows of the iterations that they come from."""

from __future__ import annotations

import numpy as np

from t6gps.learner.algorithm.pairs import Pairs, Several, every


def test_pairs_of_several_iterations_are_taken_as_from_one_array() -> None:
    rng = np.random.default_rng(0)
    parts = []
    for n in (7, 1, 12):
        observation, action = (rng.normal(size=(n, width)).astype(np.float32) for width in (5, 3))
        parts.append(Pairs(observation[:, :4], action, np.flatnonzero(rng.random(n) < 0.8)))
    several, chosen = Several(parts), rng.permutation(sum(map(len, parts)))
    wholes = (np.concatenate([part.observation[part.rows] for part in parts]),
              np.concatenate([part.action[part.rows] for part in parts]))  # fmt: skip
    for taken, whole in zip(several.take(chosen), wholes, strict=True):
        assert np.array_equal(taken, whole[chosen])
    for taken, whole in zip(every(*wholes).take(chosen), several.take(chosen), strict=True):
        assert np.array_equal(taken, whole)

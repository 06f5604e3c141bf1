"""Covariance of the exploration noise, S = s^2 1, of the policy that acted in each episode (paper Sec. II-A).

    s^2 = mean over steps and cables of |u - u_mean|^2

over all episodes that were planned with the same noise. Quiet episodes have less of it than the others, and what is
pooled over both fits neither: S would be too small for the noisy ones, and many times too large for the quiet ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from t6gps.learner.rows import Flags, Ints, Rows, root_mean_square


@dataclass(frozen=True)
class Exploration:
    """s^2 of each level of noise (m2), and the level of each row [n]."""

    variance_m2: tuple[float, ...]
    level: Ints


def exploration(rows: Rows, sampled: Flags) -> Exploration:
    """s^2 from the actions of some rows [n]; a level without such a row has 0, and nothing asks for it."""
    planned_m, level = np.unique(rows.noise_std_m, return_inverse=True)
    of_level = (np.flatnonzero(sampled & (level == number)) for number in range(len(planned_m)))
    return Exploration(tuple(_variance_m2(rows, chosen) if len(chosen) else 0.0 for chosen in of_level), level)


def _variance_m2(rows: Rows, chosen: Ints) -> float:
    return root_mean_square(chosen, lambda part: rows.action[part] - rows.action_mean[part]) ** 2

"""Time warping by uniform stretch (paper Sec. III-B; FitLocalModels, Algorithm 2, line 6).

A class has T steps, the median length of its segments. Point a of a segment with n points belongs to

    step(a) = round(a (T - 1) / (n - 1)),        the last point always to step T - 1.

In a class with an exit edge the last point is the crossing: its dynamics lead into the next triangle's frame.
The last step then holds crossings alone; all other points stay at steps 0 .. T - 2.
"""

from __future__ import annotations

import numpy as np

from t6gps.learner.rows import Ints


def class_steps(lengths: Ints, crosses: bool) -> int:
    """Number of aligned steps T of a class with segments of these lengths [m]."""
    median = int(np.floor(np.median(lengths) + 0.5))
    return max(median, 2) if crosses and lengths.max() > 1 else median


def align(point: Ints, length: Ints, steps: int, crosses: bool) -> Ints:
    """Class step of each point [n] of a segment of `length` [n] points."""
    last = length - 1
    step = (2 * point * (steps - 1) + last) // np.maximum(2 * last, 1)
    if crosses:
        step = np.minimum(step, steps - 2)
    return np.where(point == last, steps - 1, step)

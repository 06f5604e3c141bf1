"""Laws of time warping."""

from __future__ import annotations

import numpy as np
import pytest

from t6gps.learner.algorithm import warping


@pytest.mark.parametrize("crosses", [False, True])
def test_warping_keeps_order_and_maps_ends_to_ends(crosses: bool) -> None:
    for n in range(1, 25):
        for steps in range(2 if crosses else 1, 21):
            step = warping.align(np.arange(n), np.full(n, n), steps, crosses)
            assert step[-1] == steps - 1 and (np.diff(step) >= 0).all()
            assert step[0] == (0 if n > 1 else steps - 1)
            if crosses:
                assert (step == steps - 1).sum() == 1


def test_warping_is_the_identity_at_the_median_length() -> None:
    lengths = np.array([3, 7, 7, 12])
    assert warping.class_steps(lengths, False) == 7
    assert warping.align(np.arange(7), np.full(7, 7), 7, False).tolist() == list(range(7))


def test_a_crossing_has_a_step_of_its_own_even_in_a_class_of_single_steps() -> None:
    assert warping.class_steps(np.array([1, 1, 1, 5]), True) == 2
    assert warping.class_steps(np.array([1, 1]), True) == 1

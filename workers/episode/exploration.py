"""Exploration noise on the commanded rest lengths."""

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.robot.topology import CABLES_N


def noise(rng: np.random.Generator, std_m: float, correlation: float, steps: int) -> NDArray[np.float64]:
    """Stationary first-order noise, independent per cable: e' = rho e + sqrt(1 - rho^2) std n.

    One sample [steps, 24] (m) per control step, in world labels, so that it does not jump when the frame changes.
    """
    samples = std_m * rng.standard_normal((steps, CABLES_N))
    samples[1:] *= np.sqrt(1 - correlation**2)
    # Each sample is the sum of its last n innovations, weighted with powers of rho; every pass doubles n.
    n = 1
    while n < steps:
        samples[n:] += correlation**n * samples[:-n]
        n *= 2
    return samples

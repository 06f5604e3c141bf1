"""Exploration noise on the commanded rest lengths."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.topology import CABLES_N


def noise(rng: np.random.Generator, std_m: float, correlation: float, steps: int) -> Iterator[NDArray[np.float64]]:
    """Stationary first-order noise, independent per cable: e' = rho e + sqrt(1 - rho^2) std n.

    Yields one sample [24] (m) per control step, in world labels, so that it does not jump when the frame changes.
    """
    innovations = std_m * rng.standard_normal((steps, CABLES_N))
    innovations[1:] *= np.sqrt(1 - correlation**2)
    sample = np.zeros(CABLES_N)
    for innovation in innovations:
        sample = correlation * sample + innovation
        yield sample

"""Exploration noise on the commanded rest lengths."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from t6gps.workers.topology import CABLES_N


def noise(rng: np.random.Generator, std_m: float, correlation: float) -> Iterator[NDArray[np.float64]]:
    """Stationary first-order noise, independent per cable: e' = rho e + sqrt(1 - rho^2) std n.

    Yields one sample [24] (m) per control step, in world labels, so that it does not jump when the frame changes.
    """
    sample = std_m * rng.standard_normal(CABLES_N)
    while True:
        yield sample
        sample = correlation * sample + np.sqrt(1 - correlation**2) * std_m * rng.standard_normal(CABLES_N)

"""How far what was promised is realised: correlation and slope, with intervals over resampled episodes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Figures = dict[str, float | None]
RESAMPLED_N = 1000
INTERVAL = (2.5, 97.5)
"""Ends of an interval, in percent of the resampled values."""


def agreement(
    promised: Array, realised: Array, episode: NDArray[np.int64], rng: np.random.Generator
) -> dict[str, float]:
    """Of values [n] of some episodes [n]: their correlation, and the slope of the realised ones over the promised.

    Both have the ends of their 95 % intervals: episodes are drawn with replacement, as values of one hang together.
    """
    x, y = np.asarray(promised, dtype=np.float64), np.asarray(realised, dtype=np.float64)
    _, number = np.unique(episode, return_inverse=True)
    powers = np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=1)
    sums = np.zeros((number.max() + 1, powers.shape[1]))
    np.add.at(sums, number, powers)
    drawn = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), RESAMPLED_N).astype(np.float64)
    correlation, slope = _related(sums.sum(axis=0))
    figures = {"n": float(len(x)), "correlation": float(correlation), "slope": float(slope)}
    for name, values in zip(("correlation", "slope"), _related((drawn @ sums).T), strict=True):
        low, high = np.percentile(values, INTERVAL)
        figures |= {f"{name}_low": float(low), f"{name}_high": float(high)}
    return figures


def _related(sums: Array) -> tuple[Array, Array]:
    """Correlation and slope of n, sums of x, y, x2, y2 and xy [6, ...]."""
    n, x, y, xx, yy, xy = sums
    within, across = xx - x * x / n, xy - x * y / n
    return across / np.sqrt(within * (yy - y * y / n)), across / within


def mean_and_error(values: Array) -> tuple[float, float]:
    """Mean and its standard error over values [n], n > 1."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def named(prefix: str, figures: dict[str, float]) -> Figures:
    """The figures with a prefix to their names."""
    return {f"{prefix}_{name}": value for name, value in figures.items()}

"""How far what was promised is realised: correlation and slope, with intervals over resampled episodes."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating]
Figures = dict[str, float | None]
RESAMPLED_N = 1000
INTERVAL = (2.5, 97.5)
"""Ends of an interval, in percent of the resampled values."""
PLAIN = ("correlation", "slope")
NAMES = tuple(f"{name}{end}" for name in PLAIN for end in ("", "_low", "_high"))


def agreement(promised: Array, realised: Array, episode: NDArray[np.int64], rng: np.random.Generator) -> Figures:
    """Of values [n] of some episodes [n]: their correlation, and the slope of the realised ones over the promised.

    Both have the ends of their 95 % intervals: episodes are drawn with replacement, as values of one hang together.
    None stands for what so few values, or so few episodes, do not have.
    """
    x, y = np.asarray(promised, dtype=np.float64), np.asarray(realised, dtype=np.float64)
    numbers, number = np.unique(episode, return_inverse=True)
    sums = np.zeros((len(numbers), 6))
    np.add.at(sums, number, np.stack([np.ones_like(x), x, y, x * x, y * y, x * y], axis=1))
    figures: Figures = {"n": float(len(x))} | dict.fromkeys(NAMES)
    if len(x):
        drawn = rng.multinomial(len(sums), np.full(len(sums), 1 / len(sums)), RESAMPLED_N).astype(np.float64)
        for name, value, resampled in zip(PLAIN, _related(sums.sum(axis=0)), _related((drawn @ sums).T), strict=True):
            ends = np.percentile(resampled, INTERVAL) if np.isfinite(resampled).all() else (np.nan, np.nan)
            values = zip((name, f"{name}_low", f"{name}_high"), (value, *ends), strict=True)
            figures |= {key: float(number) if np.isfinite(number) else None for key, number in values}
    return figures


def _related(sums: Array) -> tuple[Array, Array]:
    """Correlation and slope of n, sums of x, y, x2, y2 and xy [6, ...]; not finite where x or y do not vary."""
    n, x, y, xx, yy, xy = sums
    within, across = xx - x * x / n, xy - x * y / n
    with np.errstate(divide="ignore", invalid="ignore"):
        return across / np.sqrt(within * (yy - y * y / n)), across / within


def mean_and_error(values: Array) -> tuple[float, float]:
    """Mean and its standard error over values [n], n > 1."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def named(prefix: str, figures: Mapping[str, float | None]) -> Figures:
    """The figures with a prefix to their names."""
    return {f"{prefix}_{name}": value for name, value in figures.items()}

"""Surrogate models of the last iteration, class by class and time step by time step (paper Sec. III-D, V-B)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from t6gps.service.views.paper.material import Material
from t6gps.service.views.run_figures import STYLE, Array, canvas
from t6gps.workers.robot.symmetry import EDGE_NAMES
from t6gps.workers.robot.topology import KIND_NAMES

SHADES_N = 256
"""Colours of a quantity that is no count."""


class Bin(NamedTuple):
    """Models of one group of samples.

    samples    at its first time step, over all modes
    modes      at each time step [T_xi]; NaN where there is none
    residual   mean over a step's samples in standard deviations [T_xi]; NaN where there is none
    """

    name: str
    samples: int
    modes: Array
    residual: Array


def bins(models: pa.Table) -> list[Bin]:
    """The bins of an iteration's rows of `models`, those with most samples first."""
    rows: dict[int, list[Mapping[str, object]]] = {}
    for row in models.to_pylist():
        rows.setdefault(row["bin"], []).append(row)
    found = [_bin(of_bin) for of_bin in rows.values()]
    return sorted(found, key=lambda each: -each.samples)


def _bin(rows: Sequence[Mapping[str, object]]) -> Bin:
    steps, samples = (np.array([row[name] for row in rows], dtype=int) for name in ("step", "samples"))
    residual = np.array([row["residual"] for row in rows], dtype=float)
    length = int(steps.max()) + 1
    weight = np.where(np.isfinite(residual), samples, 0)
    sums = np.bincount(steps, np.nan_to_num(residual) * weight, length)
    counts, modes = np.bincount(steps, weight, length), np.bincount(steps, minlength=length).astype(float)
    mean = np.divide(sums, counts, out=np.full(length, np.nan), where=counts > 0)
    return Bin(_name(rows[0]), int(samples[steps == steps.min()].sum()), np.where(modes > 0, modes, np.nan), mean)


def _name(row: Mapping[str, object]) -> str:
    """What the samples of a bin have in common, in words."""
    kind, entry, exit_ = (row[name] for name in ("kind", "entry_edge", "exit_edge"))
    if not isinstance(kind, int):
        return f"group {row['bin']}"
    edges = [EDGE_NAMES[kind][edge] if isinstance(edge, int) else "·" for edge in (entry, exit_)]
    way = f"any → {edges[1]}, rare" if row["pooled"] else " → ".join(edges)
    return f"{KIND_NAMES[kind]}  {way}{', cut' if row['truncated'] else ''}"


def models(material: Material) -> Figure:
    """Number of modes, and residual of their fits, of each class at each aligned time step."""
    found, iteration = bins(material.models), material.models["iteration"][0].as_py()
    with rc_context(STYLE):
        figure = canvas(9.4, 1.5 + 0.24 * len(found))
        left, right = figure.subplots(1, 2, sharey=True)
        modes = _grid([each.modes for each in found])
        most = max(int(np.nanmax(modes)), 1)
        _map(figure, left, modes, "modes", (0.5, most + 0.5), most)
        for (row, step), value in np.ndenumerate(modes):
            if np.isfinite(value):
                ink = "white" if value <= (most + 1) / 2 else "black"
                left.annotate(f"{value:.0f}", (step, row), ha="center", va="center", fontsize=6.5, color=ink)
        residual = _grid([each.residual for each in found])
        _map(
            figure,
            right,
            residual,
            "residual (standard deviations)",
            (0, max(float(np.nanmax(residual)), 1e-9)),
            SHADES_N,
        )
        left.set_yticks(range(len(found)), [f"{each.name}  ({each.samples:,})" for each in found], fontsize=8.5)
        left.set_ylabel("class (samples); ·: no edge", fontsize=9)
        left.set_title(f"Modes, iteration {iteration}", fontsize=9.5)
        right.set_title("Residual of the fits", fontsize=9.5)
    return figure


def _grid(rows: Sequence[Array]) -> Array:
    """Rows of different lengths as one array, NaN where a row has ended."""
    grid = np.full((len(rows), max(map(len, rows))), np.nan)
    for row, values in zip(grid, rows, strict=True):
        row[: len(values)] = values
    return grid


def _map(figure: Figure, axes: Axes, grid: Array, label: str, limits: tuple[float, float], colours_n: int) -> None:
    colours = colormaps["cividis"].resampled(colours_n)
    image = axes.imshow(grid, cmap=colours, vmin=limits[0], vmax=limits[1], aspect="auto", interpolation="none")
    bar = figure.colorbar(image, ax=axes, label=label, location="bottom", shrink=0.7, aspect=30)
    if colours_n < SHADES_N:
        bar.set_ticks(range(1, colours_n + 1))
    axes.grid(visible=False)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.set_xlabel("aligned time step of the class")

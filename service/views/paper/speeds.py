"""How fast the robot goes to its waypoint, state by state (paper Sec. V-B, right figure)."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from t6gps.service.views.paper.material import Material
from t6gps.service.views.run_figures import BLUE, DARK, ORANGE, SPEED, STYLE, Array, canvas, numbers

BIN_M_PER_S = 0.04
STUCK_M_PER_S = 0.05
"""The paper calls states with velocity close to 0 stuck."""
SHOWN_PERCENT = (0.1, 99.9)
"""The axis leaves out rarer speeds at both ends; densities count them."""


def speeds(material: Material) -> Figure:
    """Densities of the forward speed: noise-free episodes, and samples of the last iteration with their noise."""
    parts = (
        ("noise-free", numbers(material.frames, SPEED), {"color": BLUE, "linewidth": 2.0}),
        ("samples, with noise", numbers(material.sampled, SPEED), {"color": ORANGE, "linestyle": "--"}),
    )
    everything = np.concatenate([values for _, values, _ in parts])
    with rc_context(STYLE):
        figure = canvas(4.8, 3.9)
        axes = figure.subplots()
        for name, values, look in parts:
            label = f"{name}: mean {values.mean():.2f} m/s, {share_stuck(values):.0%} within ±{STUCK_M_PER_S} m/s"
            axes.hist(values, edges(everything).tolist(), density=True, histtype="step", label=label, **look)
        axes.axvline(0, color=DARK, linewidth=0.8)
        low, high = np.percentile(everything, SHOWN_PERCENT)
        axes.set(xlim=(low, high), xlabel="speed to the waypoint (m/s)", ylabel="density (s/m)")
        figure.legend(loc="outside lower center", fontsize=9)
    return figure


def edges(values: Array) -> Array:
    """Edges of bins of BIN_M_PER_S that hold all values; 0 is one of them."""
    first, last = np.floor(values.min() / BIN_M_PER_S), np.floor(values.max() / BIN_M_PER_S) + 1
    return BIN_M_PER_S * np.arange(first, last + 1)


def share_stuck(values: Array) -> float:
    """Share of speeds that are close to 0."""
    return float((np.abs(values) < STUCK_M_PER_S).mean())

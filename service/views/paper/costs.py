"""Cost by iteration, and what the surrogate models promised of it (paper Sec. V-B, left figure)."""

from __future__ import annotations

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from t6gps.service.views.paper.material import Material
from t6gps.service.views.run_figures import BLUE, DARK, GREY, ORANGE, STYLE, canvas, numbers


def costs(material: Material) -> Figure:
    """Left: mean cost of each iteration's samples and of the noise-free episodes. Right: promised and realised change.

    Both are over the version of the policy that acts: what an iteration promises, the next version is to keep.
    """
    with rc_context(STYLE):
        figure = canvas(8.4, 3.4)
        left, right = figure.subplots(1, 2)
        _samples(left, material)
        _promises(right, material)
        for axes in (left, right):
            axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
            axes.set_xlabel("version of the policy (iteration)")
    return figure


def _samples(axes: Axes, material: Material) -> None:
    version, cost = (numbers(material.iterations, name) for name in ("policy_version", "cost"))
    error = np.nan_to_num(numbers(material.iterations, "cost_standard_error"))
    state = material.config.learner.reduced_state
    axes.errorbar(version, cost, error, color=BLUE, capsize=3, marker="o", label=f"samples, surrogates of {state}")
    axes.errorbar(
        numbers(material.evaluation, "policy_version"),
        numbers(material.evaluation, "cost"),
        np.nan_to_num(numbers(material.evaluation, "cost_standard_error")),
        color=ORANGE,
        capsize=3,
        marker="D",
        markeredgecolor=DARK,
        label="noise-free episodes",
    )
    axes.set(title="Cost", ylabel="mean running cost (m²/s²)")
    axes.legend()


def _promises(axes: Axes, material: Material) -> None:
    iteration = numbers(material.iterations, "iteration")
    promised, realised = (numbers(material.iterations, f"{word}_cost_change") for word in ("predicted", "realised"))
    axes.axhline(0, color=GREY, linewidth=1)
    axes.plot(iteration + 1, promised, color=ORANGE, marker="s", linestyle="--", label="promised by the surrogates")
    axes.plot(numbers(material.iterations, "policy_version"), realised, color=BLUE, marker="o", label="realised")
    axes.set(title="Change of the cost", ylabel="against the iteration before (m²/s²)")
    axes.legend()

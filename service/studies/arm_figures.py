"""Figures that compare the arms of a study, drawn from the tables and evaluations of its runs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import cycle

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from t6gps.service.studies import ground_figures
from t6gps.service.studies.conduct import Finished
from t6gps.service.training.evaluation import Evaluation
from t6gps.service.views.run_figures import BLUE, DARK, GREEN, GREY, ORANGE, PURPLE, RED, SKY, STYLE, canvas, numbers
from t6gps.storage import tables

COLOURS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, DARK, GREY)
"""Of the arms of a panel in their order; from the ninth on they come again."""
QUANTITIES = {
    "forward_speed_m_per_s": ("speed to the waypoint (m/s)", 1),
    "stuck_share_by_distance": ("stuck: below 5 cm in 1 s (%)", 100),
    "stuck_share_by_speed": ("below 0.05 m/s (%)", 100),
    "waypoints_per_episode": ("waypoints per episode", 1),
    "cost": ("cost (m²/s²)", 1),
}
LEARNING = {"cost": "cost (m²/s²)", "forward_speed_m_per_s": "speed to the waypoint (m/s)"}
Values = np.ndarray


def by_panel(finished: Sequence[Finished]) -> dict[str, dict[str, list[Finished]]]:
    """Runs by panel and label, in the order of their declaration."""
    panels: dict[str, dict[str, list[Finished]]] = {}
    for outcome in finished:
        arm = outcome.trial.declared
        panels.setdefault(arm.panel, {}).setdefault(arm.label, []).append(outcome)
    return panels


def evaluations(finished: Sequence[Finished]) -> Figure:
    """The noise-free policies: a dot per seed, a line from the mean one standard deviation each way."""
    panels = by_panel(finished)
    with rc_context(STYLE):
        heights = [len(labels) + 0.6 for labels in panels.values()]
        figure = canvas(13, 1.1 + 0.42 * sum(heights))
        grid = figure.subplots(len(panels), len(QUANTITIES), squeeze=False, height_ratios=heights, sharex="col")
        for row, (panel, labels) in zip(grid, panels.items(), strict=True):
            for column, (key, (title, factor)) in enumerate(QUANTITIES.items()):
                axes = row[column]
                for place, (runs, colour) in enumerate(zip(labels.values(), cycle(COLOURS), strict=False)):
                    _dots(axes, place, factor * _known([outcome.evaluation for outcome in runs], key), colour)
                axes.set_yticks(range(len(labels)), list(labels) if column == 0 else [""] * len(labels))
                axes.set_ylim(len(labels) - 0.4, -0.6)
                axes.grid(visible=False, axis="y")
                axes.xaxis.set_major_locator(MaxNLocator(4))
                axes.set_xlabel(title if panel == list(panels)[-1] else "")
            row[0].set_title(panel)
    return figure


def _known(evaluations: Sequence[Evaluation], key: str) -> Values:
    """Means of a quantity in the evaluations that have it."""
    means = [evaluation.estimates()[key].mean for evaluation in evaluations]
    return np.array([mean for mean in means if mean is not None], dtype=float)


def _dots(axes: Axes, place: float, values: Values, colour: str) -> None:
    if len(values) > 1:
        axes.plot(values.mean() + values.std(ddof=1) * np.array([-1, 1]), [place, place], color=colour, alpha=0.5)
        axes.plot(values.mean(), place, color=colour, marker="|", markersize=13, markeredgewidth=2)
    axes.plot(values, np.full(len(values), place), color=colour, marker="o", linestyle="", markersize=4.5, alpha=0.8)


def learning(finished: Sequence[Finished]) -> Figure:
    """Cost and speed of the samples of each iteration: mean over seeds, and the range of the seeds.

    Over the steps sampled before where iterations differ in size.
    """
    learners = [outcome for outcome in finished if outcome.trial.declared.baseline is None]
    panels, same_size = by_panel(learners), len({_iteration_steps(outcome) for outcome in learners}) == 1
    with rc_context(STYLE):
        figure = canvas(1.5 + 4 * len(panels), 6)
        grid = figure.subplots(len(LEARNING), len(panels), squeeze=False, sharey="row", sharex=True)
        for column, (panel, labels) in enumerate(panels.items()):
            for row, (key, title) in enumerate(LEARNING.items()):
                axes = grid[row, column]
                for (label, runs), colour in zip(labels.items(), cycle(COLOURS), strict=False):
                    curves = np.array([numbers(_iterations(outcome), key) for outcome in runs])
                    x = np.arange(curves.shape[1]) * (1.0 if same_size else _iteration_steps(runs[0]) / 1000)
                    axes.fill_between(x, curves.min(axis=0), curves.max(axis=0), color=colour, alpha=0.15, linewidth=0)
                    axes.plot(x, curves.mean(axis=0), color=colour, marker="o", markersize=4, label=label)
                if row == 0:
                    axes.set_title(panel)
                else:
                    axes.set_xlabel("iteration" if same_size else "steps sampled before (thousand)")
                if column == 0:
                    axes.set_ylabel(title)
                axes.xaxis.set_major_locator(MaxNLocator(integer=True, min_n_ticks=1))
        grid[0, -1].legend()
    return figure


def _iteration_steps(outcome: Finished) -> int:
    return outcome.trial.config.run.episodes * outcome.trial.config.run.steps


def _iterations(outcome: Finished) -> pa.Table:
    return tables.read(outcome.run, "iterations").sort_by("iteration")


def _newest(outcome: Finished, table: str, columns: list[str]) -> pa.Table:
    newest = tables.committed_iterations(outcome.run) - 1
    return tables.read(outcome.run, table, columns, pc.field("iteration") == newest)


def speed_distribution(finished: Sequence[Finished]) -> Figure:
    """Distribution of the forward speed in the samples of the last iteration (paper Sec. V-B, right figure)."""
    panels = by_panel(finished)
    bins = np.linspace(-1, 1.6, 66)
    with rc_context(STYLE):
        figure = canvas(1.5 + 4 * len(panels), 3.6)
        for axes, (panel, labels) in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
        ):
            for (label, runs), colour in zip(labels.items(), cycle(COLOURS), strict=False):
                speeds = [numbers(_newest(outcome, "frames", ["forward_speed_m_per_s"]), SPEED) for outcome in runs]
                axes.hist(np.concatenate(speeds), bins, density=True, histtype="step", color=colour, label=label)
            axes.axvline(0, color=DARK, linewidth=0.8)
            axes.set(title=panel, xlabel="speed to the waypoint (m/s)", ylabel="density (s/m)")
        axes.legend()
    return figure


SPEED = "forward_speed_m_per_s"


def modes_per_class(finished: Sequence[Finished]) -> Figure:
    """Modes per time step of each class in the last iteration over the class's size: one dot per class and seed."""
    panels = by_panel(finished)
    with rc_context(STYLE):
        figure = canvas(1.5 + 4 * len(panels), 3.6)
        for axes, (panel, labels) in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
        ):
            for (label, runs), colour in zip(labels.items(), cycle(COLOURS), strict=False):
                rows = [row for outcome in runs for row in _newest(outcome, "classes", CLASS_COLUMNS).to_pylist()]
                alone = [row for row in rows if not row["pooled"]]
                sizes, modes = [row["segments"] for row in alone], [row["modes"] for row in alone]
                axes.plot(sizes, modes, linestyle="", marker="o", alpha=0.6, color=colour, label=label)
            axes.set(title=panel, xlabel="segments of the class", ylabel="modes per time step", xscale="log")
        axes.legend()
    return figure


def conditions(finished: Sequence[Finished]) -> Figure:
    """Speed and stuck share of every arm in its own world and under each condition: a dot per seed."""
    names = list(finished[0].conditions)
    arms: dict[str, list[Finished]] = {}
    for outcome in finished:
        arms.setdefault(outcome.trial.declared.label, []).append(outcome)
    chosen = ("forward_speed_m_per_s", "stuck_share_by_distance")
    with rc_context(STYLE):
        figure = canvas(9, 1.3 + 0.3 * (len(names) + 1) * len(arms))
        for axes, key in zip(figure.subplots(1, len(chosen), sharey=True), chosen, strict=True):
            title, factor = QUANTITIES[key]
            for shift, (label, runs) in enumerate(arms.items()):
                colour, lift = COLOURS[shift % len(COLOURS)], 0.7 * (shift - (len(arms) - 1) / 2) / len(arms)
                axes.plot([], [], color=colour, marker="o", linestyle="", label=label)
                for place, name in enumerate([None, *names]):
                    worlds = [outcome.evaluation if name is None else outcome.conditions[name] for outcome in runs]
                    _dots(axes, place + lift, factor * _known(worlds, key), colour)
            axes.set_yticks(range(len(names) + 1), ["as trained", *names])
            axes.set_ylim(len(names) + 0.6, -0.6)
            axes.set_xlabel(title)
        if len(arms) > 1:
            handles, labels = axes.get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper center", ncols=len(arms))
    return figure


def along_training(finished: Sequence[Finished]) -> Figure:
    """Speed of the noise-free policy over steps and over seconds of training: rivals as lines, T6-GPS as dots."""
    arms: dict[str, list[Finished]] = {}
    for outcome in finished:
        arms.setdefault(outcome.trial.declared.label, []).append(outcome)
    with rc_context(STYLE):
        figure = canvas(12, 4.5)
        panels = figure.subplots(1, 2, sharey=True)
        for number, (label, runs) in enumerate(arms.items()):
            points = np.mean([_along(outcome) for outcome in runs], axis=0)
            marker = "o" if runs[0].curve else "*"
            for axes, x in zip(panels, points.T, strict=False):
                colour, dashed = COLOURS[number % len(COLOURS)], number >= len(COLOURS)
                axes.plot(x, points[:, 2], "--" if dashed else "-", color=colour, marker=marker, label=label)
        for axes, title in zip(panels, ("control steps", "seconds of training by the clock"), strict=True):
            axes.set(xlabel=title, xscale="symlog")
        panels[0].set_ylabel("speed to the waypoint (m/s)")
        figure.legend(*axes.get_legend_handles_labels(), loc="outside right upper")
    return figure


def _along(outcome: Finished) -> Values:
    """Steps, seconds of training and speed [n, 3]: of each mark of a rival, or of a finished training of T6-GPS."""
    if outcome.curve:
        points = [(point.steps, point.wall_s, point.evaluation) for point in outcome.curve]
    else:
        spent_s = sum(np.nansum(numbers(_iterations(outcome), column)) for column in SPENT)
        points = [(outcome.trial.training_steps, float(spent_s), outcome.evaluation)]
    return np.array([(steps, wall_s, result.forward_speed_m_per_s.mean) for steps, wall_s, result in points])


SPENT = ("sampling_s", "segmenting_s", "fitting_s", "backward_pass_s", "supervised_s")
CLASS_COLUMNS = ["kind", "entry_edge", "exit_edge", "segments", "pooled", "modes"]

FIGURES: dict[str, Callable[[Sequence[Finished]], Figure]] = {
    "evaluations": evaluations,
    "learning": learning,
    "speed_distribution": speed_distribution,
    "modes_per_class": modes_per_class,
    "conditions": conditions,
    "along_training": along_training,
    "ground_track": ground_figures.ground_track,
    "footprints": ground_figures.footprints,
    "climb": ground_figures.climb,
    "climbs": ground_figures.climbs,
    "any_axis": ground_figures.any_axis,
    "grades": ground_figures.grades,
}
"""Every study has the first two; a study names the others it wants."""

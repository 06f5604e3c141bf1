"""A stretch of an episode in pictures of the project's own renderer, with the heights along it (paper Sec. V-C)."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
from matplotlib import rc_context
from matplotlib.figure import Figure

from t6gps.service.views.paper.stretch import Stretch, track
from t6gps.service.views.run_figures import BLUE, DARK, GREY, STYLE, canvas, numbers
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures import render
from t6gps.workers.pictures.scene import Sizes

SNAPSHOTS_N = 6


def snapshots(frames: pa.Table, terrain: Terrain | None, shown: Stretch, sizes: Sizes, title: str) -> Figure:
    """SNAPSHOTS_N poses spread evenly over a stretch; below, heights over the time, with a line for each pose."""
    steps = np.unique(np.linspace(shown.first, shown.last, SNAPSHOTS_N).round().astype(int)).tolist()
    picture = render.snapshots(frames, terrain, steps, sizes)
    rows = slice(max(shown.first - 50, 0), shown.last + 51)
    time_s, height_m = numbers(frames, "time_s")[rows], numbers(frames, "com_z_m")[rows]
    with rc_context(STYLE):
        figure = canvas(9.4, 6.3)
        above, below = figure.subplots(2, 1, height_ratios=[2.6, 1])
        above.imshow(picture)
        above.set_axis_off()
        above.set_title(title)
        below.plot(time_s, height_m, color=BLUE, label="centre of mass")
        ground_m = np.zeros_like(height_m) if terrain is None else terrain.height(*track(frames)[rows].T)
        below.plot(time_s, ground_m, color=GREY, linestyle="--", label="ground below")
        for step in steps:
            below.axvline(numbers(frames, "time_s")[step], color=DARK, linewidth=0.8, linestyle=":")
        below.set(xlabel="time (s)", ylabel="height (m)")
        below.margins(x=0)
        below.legend(ncols=2, loc="lower right", bbox_to_anchor=(1, 1))
    return figure

"""How the Rerun viewer lays out a recording: space on the left, numbers over time on the right."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

Array = NDArray[np.float64]

ABOUT = """
# {name}

| | |
|---|---|
{rows}

**Units.** Lengths are in m, times in s. Names of series say the others.

**Cables.** Colours show the tension, from blue (slack) to red ({brightest_n:.0f} N or more). Series of cables have a
line for each of the 24, in their own order.

**Support triangle.** Blue for a Delta, magenta for a Lambda.

**Waypoint.** The yellow circle: the waypoint is reached within it.

**Segments.** `class` names the edges through which a triangle is entered and left, `...` where the episode begins or
ends, or the robot jumps. `stuck` lasts while the robot is less than 5 cm from where it was 1 s before.
"""
"""A page with the numbers of the episode, and what the colours mean."""


def layout(eye: Array, target: Array, flat: bool) -> rrb.Blueprint:
    """Views of a recording. From `eye` one looks at `target` (m) and follows the centre of mass; a plane has lines."""
    space = rrb.Spatial3DView(
        origin="/world",
        name="Space (m)",
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital,
            position=eye,
            look_target=target,
            eye_up=(0.0, 0.0, 1.0),
            tracking_entity="/world/com",
        ),
        line_grid=rrb.LineGrid3D(
            visible=flat, spacing=1.0, plane=rr.components.Plane3D.XY.with_distance(0.01), color=(0, 0, 0, 110)
        ),
    )
    cables = [
        rrb.TimeSeriesView(origin=f"/cables/{name}", name=title, plot_legend=rrb.PlotLegend(visible=False))
        for name, title in (
            ("tension_n", "Tensions (N)"),
            ("command_m", "Commands (m)"),
            ("rest_length_m", "Rest lengths (m)"),
        )
    ]
    speeds = ["/frames/forward_speed_m_per_s", "/frames/speed_m_per_s"]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Tabs(space, rrb.TextDocumentView(origin="/about", name="About")),
            rrb.Vertical(
                rrb.TimeSeriesView(origin="/frames", contents=speeds, name="Speeds (m/s)"),
                rrb.TimeSeriesView(origin="/frames/cost", name="Cost (m2/s2)"),
                rrb.Tabs(*cables),
                rrb.StateTimelineView(origin="/segments", name="Segments"),
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )

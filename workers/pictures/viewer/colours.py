"""Colours as Rerun takes them: 0xRRGGBBAA, all of them opaque."""

from __future__ import annotations

import numpy as np
from matplotlib import colormaps
from numpy.typing import NDArray

from t6gps.workers.pictures.render import ROD_COLOURS, TRIANGLE_COLOURS, WAYPOINT_COLOUR
from t6gps.workers.pictures.scene import BAR, CAP

Array = NDArray[np.float64]
Colours = NDArray[np.uint32]

TENSIONS = colormaps["turbo"]
"""From blue over green to red."""


def of_light(light: NDArray[np.floating]) -> Colours:
    """The colours [n] of linear light [n, 3]."""
    return _packed((255 * np.asarray(light) ** (1 / 2.2)).astype(np.uint8))


def of_tensions(tensions_n: Array, brightest_n: float) -> Colours:
    """The colours of tensions [n]: along TENSIONS from 0 to `brightest_n`, the last one beyond."""
    return _packed(TENSIONS(np.clip(tensions_n / brightest_n, 0, 1), bytes=True)[:, :3])


def _packed(rgb: NDArray[np.uint8]) -> Colours:
    red, green, blue = np.asarray(rgb, np.uint32).T
    return np.asarray(red << 24 | green << 16 | blue << 8 | 0xFF, np.uint32)


BAR_COLOUR, NODE_COLOUR = of_light(ROD_COLOURS[[BAR, CAP]])
KIND_COLOURS = of_light(TRIANGLE_COLOURS)
"""Of support triangles: a Delta's, a Lambda's."""
(YELLOW,) = of_light(WAYPOINT_COLOUR[None])
"""Of waypoint and track."""
GREY, RED = 0x3C3C3CFF, 0xC82828FF

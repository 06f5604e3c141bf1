"""Casting the rays of a picture against ground and rods.

The image plane stands upright, as behind a shifted lens, so that each column of a picture lies in one vertical plane.
Along a column the ground then hides itself by a running maximum, and no ray has to be marched.

    eye, forward, right, up   camera centre (m) and unit axes; forward and right are horizontal
    u, v                      of a pixel: its ray is eye + d (forward + u right + v up) at depth d (m)
    a, b, r                   ends [n, 3] and radius [n] of rods with round ends (m)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]

NEAREST_M = 0.5
"""Depth from which on things are seen."""

FARTHEST_M = 80.0
"""Depth up to which things are seen: twice the width of the usual ground."""

SHADOW_TEXEL_M = 0.01
"""Side of a cell of the shadow map."""

ShadowMap = tuple[Array, Floats, Floats]
"""Plane, first corner and shares of sunlight, as `cast_shadow` describes them."""


@dataclass(frozen=True)
class Camera:
    """A level camera at `eye` [3] (m), looking along `forward` [2]; `u` [w] and `v` [h] of its columns and rows."""

    eye: Array
    forward: Array
    u: Floats
    v: Floats

    @property
    def right(self) -> Array:
        """Horizontal unit vector to the right [2]."""
        return np.array([self.forward[1], -self.forward[0]])

    @property
    def pixel(self) -> float:
        """Width of a pixel at depth 1 m (m)."""
        return float(self.u[1] - self.u[0])

    def project(self, points: Array) -> tuple[Array, Array, Array]:
        """Column, row (fractional pixel numbers) and depth (m) of points [..., 3]."""
        offset = points - self.eye
        depth = offset[..., :2] @ self.forward
        column = (offset[..., :2] @ self.right / depth - self.u[0]) / self.pixel
        return column, (self.v[0] - offset[..., 2] / depth) / self.pixel, depth

    def points(self, rows: Ints | slice, columns: Ints | slice, depth: Array | Floats) -> list[Floats]:
        """x, y, z (m) of the pixels in `rows` and `columns` at the given depths; whole pictures take slices."""
        u = self.u[columns]
        v = self.v[rows, None] if isinstance(rows, slice) else self.v[rows]
        eye, (fx, fy), (rx, ry) = self.eye.tolist(), self.forward.tolist(), self.right.tolist()
        return [eye[0] + depth * (fx + u * rx), eye[1] + depth * (fy + u * ry), eye[2] + depth * v]


def cast_ground(camera: Camera, height: Callable[[Array, Array], Array], creases: Array) -> Floats:
    """Depth of the ground in each pixel [h, w] (m), infinite where the sky is seen.

    `height(x, y)` (m) must be linear between the lines n_x x + n_y y = c, the rows [n_x, n_y, c] of `creases` [k, 3].
    Sampled at its creases alone, such a ground is drawn exactly.
    """
    h, w = len(camera.v), len(camera.u)
    ray = camera.forward[:, None] + camera.right[:, None] * camera.u
    with np.errstate(divide="ignore", invalid="ignore"):
        crossings = (creases[:, 2] - creases[:, :2] @ camera.eye[:2])[:, None] / (creases[:, :2] @ ray)
    seen = (crossings > NEAREST_M) & (crossings < FARTHEST_M)
    ends = np.broadcast_to([[NEAREST_M], [FARTHEST_M]], (2, w))
    depths = np.sort(np.concatenate([ends, np.where(seen, crossings, FARTHEST_M)]), axis=0)
    depths = depths[: 2 + seen.sum(axis=0).max(initial=0)]
    rise = (height(*(camera.eye[i] + depths * ray[i] for i in range(2))) - camera.eye[2]).astype(np.float32)
    depths = depths.astype(np.float32)
    horizon = np.maximum.accumulate(rise / depths, axis=0)
    # A sample lies below the rays of all rows above its horizon: count such samples for each pixel.
    below = np.clip(np.ceil((camera.v[0] - horizon) / camera.pixel), 0, h).astype(np.int64)
    counts = np.bincount((below * w + np.arange(w)).ravel(), minlength=(h + 1) * w).reshape(h + 1, w)
    first = np.cumsum(counts[::-1], axis=0, dtype=np.int32)[::-1][1:]
    after = np.asarray(np.clip(first, 1, len(depths) - 1) * w + np.arange(w), dtype=np.intp)
    near, far = depths.take(after - w), depths.take(after)
    v = camera.v[:, None]
    gap_near = rise.take(after - w) - v * near
    gap_far = rise.take(after) - v * far
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = near - (far - near) * gap_near / (gap_far - gap_near)
    return np.where(first == len(depths), np.float32(np.inf), depth)


def cast_rods(camera: Camera, a: Array, b: Array, r: Array, behind: Floats) -> tuple[Ints, Ints, Ints, Array]:
    """Row, column, rod and depth (m) of each pixel in which a rod is the nearest thing, nearer than `behind` [h, w]."""
    rod, rows, columns = _covered(camera, a, b, r)
    ray = np.column_stack(
        [
            camera.forward[0] + camera.u[columns] * camera.right[0],
            camera.forward[1] + camera.u[columns] * camera.right[1],
            camera.v[rows],
        ]
    )
    depth = _meet_rod(camera.eye, ray, a[rod], b[rod], r[rod])
    seen = np.flatnonzero(depth < behind[rows, columns])
    farthest_first = seen[np.argsort(-depth[seen], kind="stable")]
    nearest = np.full(behind.size, -1)
    nearest[rows[farthest_first] * behind.shape[1] + columns[farthest_first]] = farthest_first
    chosen = nearest[nearest >= 0]
    return rows[chosen], columns[chosen], rod[chosen], depth[chosen]


def _covered(camera: Camera, a: Array, b: Array, r: Array) -> tuple[Ints, Ints, Ints]:
    """Rod, row and column of all pixels that a rod may cover: spans of rows along its projected axis."""
    column_a, row_a, depth_a = camera.project(a)
    column_b, row_b, depth_b = camera.project(b)
    ahead = np.minimum(depth_a, depth_b) > NEAREST_M
    reach = np.where(ahead, 1.3 * r / np.minimum(depth_a, depth_b) / camera.pixel + 1, 0)
    top = np.maximum(np.floor(np.minimum(row_a, row_b) - reach), 0)
    bottom = np.minimum(np.ceil(np.maximum(row_a, row_b) + reach), len(camera.v) - 1)
    rod, rows = _ranges(top, np.where(ahead, bottom, -1))
    drop, run = (row_b - row_a)[rod], (column_b - column_a)[rod]
    level = np.abs(drop) < 1e-6
    drop = np.where(level, 1.0, drop)
    centre = column_a[rod] + (rows - row_a[rod]) / drop * run
    half = np.where(level, np.inf, reach[rod] * np.hypot(run, drop) / np.abs(drop))
    left = np.maximum(centre - half, (np.minimum(column_a, column_b) - reach)[rod])
    right = np.minimum(centre + half, (np.maximum(column_a, column_b) + reach)[rod])
    span, columns = _ranges(np.maximum(np.floor(left), 0), np.minimum(np.ceil(right), len(camera.u) - 1))
    return rod[span], rows[span], columns


def _ranges(first: Array, last: Array) -> tuple[Ints, Ints]:
    """All integers from first to last (included) of each range, with the number of their range."""
    lengths = np.maximum(last - first + 1, 0).astype(np.int64)
    number = np.repeat(np.arange(len(lengths)), lengths)
    within = np.arange(len(number)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return number, first.astype(np.int64)[number] + within


def _dot(p: Array, q: Array) -> Array:
    return np.einsum("...i,...i->...", p, q)


def _meet_rod(eye: Array, ray: Array, a: Array, b: Array, r: Array) -> Array:
    """Depth at which each ray enters its rod [m]; NaN where it misses."""
    axis, from_a = b - a, eye - a
    length2, along, start = _dot(axis, axis), _dot(axis, ray), _dot(axis, from_a)
    ray2 = _dot(ray, ray)
    square = length2 * ray2 - along**2
    linear = length2 * _dot(ray, from_a) - start * along
    constant = length2 * (_dot(from_a, from_a) - r**2) - start**2
    with np.errstate(invalid="ignore", divide="ignore"):
        side = (-linear - np.sqrt(linear**2 - square * constant)) / square
        place = start + side * along
        on_side = (place > 0) & (place < length2)
        from_end = np.where((place > 0)[:, None], eye - b, from_a)
        linear = _dot(ray, from_end)
        end = (-linear - np.sqrt(linear**2 - ray2 * (_dot(from_end, from_end) - r**2))) / ray2
    return np.where(on_side, side, end)


def cast_shadow(sun: Array, ground_m: float, a: Array, b: Array, r: Array) -> ShadowMap:
    """Shadow of rods on ground that is about `ground_m` high, as a map seen from the sun; softer from higher rods.

    `sun` is the unit vector to the sun. Returns the plane [3, 2] across the sunlight, the map's first corner [2] in
    it (m), and the share of sunlight [p, q] on a grid of SHADOW_TEXEL_M.
    """
    across = np.cross(sun, [0.0, 0.0, 1.0]) / np.hypot(sun[0], sun[1])
    plane = np.stack([across, np.cross(across, sun)], axis=1)
    starts, ends = a @ plane, b @ plane
    corner = np.minimum(starts, ends).min(axis=0) - 0.2
    size = np.ceil((np.maximum(starts, ends).max(axis=0) + 0.2 - corner) / SHADOW_TEXEL_M).astype(int)
    light = np.ones(size, np.float32)
    for rod in np.column_stack([starts - corner, ends - corner, a[:, 2] - ground_m, b[:, 2] - ground_m, r]).tolist():
        (start, end), (low, high, radius) = (np.array(rod[:2]), np.array(rod[2:4])), rod[4:]
        margin = 2 * radius + 0.1
        first = ((np.minimum(start, end) - margin) / SHADOW_TEXEL_M).astype(int).clip(0)
        last = ((np.maximum(start, end) + margin) / SHADOW_TEXEL_M).astype(int)
        part = light[first[0] : last[0], first[1] : last[1]]
        x, y = (
            np.arange(f, f + n, dtype=np.float32) * SHADOW_TEXEL_M - s
            for f, n, s in zip(first, part.shape, rod[:2], strict=True)
        )
        run, drop = (end - start).tolist()
        share = np.clip((x[:, None] * run + y * drop) / max(run**2 + drop**2, 1e-9), 0, 1)
        gap = np.hypot(x[:, None] - share * run, y - share * drop)
        soft = 0.006 + 0.02 * np.clip((low + share * (high - low)) / float(sun[2]), 0, 2)
        part *= 1 - np.clip(0.5 + (radius - gap) / (2 * soft), 0, 1) * np.minimum(1, radius / soft)
    return plane, corner.astype(np.float32), light


def look_up(fields: Sequence[Floats], i: Floats, j: Floats) -> list[Floats]:
    """Values [m] of fields [p, q] at fractional grid numbers i, j [m] within them, bilinear."""
    p, q = fields[0].shape
    i0, j0 = np.clip(i.astype(np.int32), 0, p - 2), np.clip(j.astype(np.int32), 0, q - 2)
    a, b, at = i - i0, j - j0, i0 * q + j0
    result = []
    for field in fields:
        flat = field.ravel()
        low = flat.take(at)
        low += b * (flat.take(at + 1) - low)
        high = flat.take(at + q)
        high += b * (flat.take(at + q + 1) - high)
        result.append(low + a * (high - low))
    return result

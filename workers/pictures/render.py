"""Pictures and films of a recorded episode, from its states alone: nothing is simulated again.

Colours are linear light until the last step; each pixel is the mean of several rays. Light is worked out in bands of
rows, small enough for the processor's cache.

The pictures come from rays cast in numpy (`raycast`, `landscape`). VTK draws faster, but weighs half a gigabyte and
needs the graphics libraries of the system, which a fresh machine or a container lacks.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from t6gps.storage import durable
from t6gps.storage.errors import ConfigError
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.pictures import scene as scenes
from t6gps.workers.pictures.raycast import (
    SHADOW_TEXEL_M,
    Camera,
    ShadowMap,
    cast_ground,
    cast_rods,
    cast_shadow,
    look_up,
)
from t6gps.workers.pictures.scene import CABLE, POLE, TRACK, USUAL, Rods, Scene, Sizes
from t6gps.workers.robot.topology import FACES

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Picture = NDArray[np.uint8]
Progress = Callable[[int, int], None]

STILL_SIZE = (1280, 720)
"""Width and height of a still in pixels."""

PANEL_SIZE = (640, 420)
"""Of one panel of a strip."""

FILM_SIZE = (960, 540)
"""Of a film."""

STILL_SAMPLES = 3
"""Rays per pixel of a still along each axis."""

FILM_SAMPLES = 2
"""Of a film, which has hundreds of pictures."""

FRAMES_PER_S = 10
"""One picture per control step: films run at the robot's own speed."""

BAND_ROWS = 24
"""Rows of rays that are drawn at once."""

STRIP_COLUMNS = 3
"""Panels side by side."""

STRIP_GAP = 6
"""Between panels (pixels)."""

ROD_COLOURS = np.array(
    [[0.78, 0.80, 0.82], [0.85, 0.17, 0.02], [0.04, 0.05, 0.07], [0.90, 0.88, 0.85], [1.00, 0.62, 0.05]], np.float32
)
TRIANGLE_COLOURS = np.array([[0.02, 0.30, 0.85], [0.75, 0.08, 0.45]], np.float32)
"""Of a Delta and of a Lambda."""
WAYPOINT_COLOUR = np.array([1.00, 0.62, 0.05], np.float32)

SUN = np.array([1.38, 1.24, 1.00], np.float32)
"""Light of the sun: warm."""

SKY = np.array([0.27, 0.34, 0.46], np.float32)
"""Light of the sky, also in the shade: cold."""

HORIZON = np.array([0.60, 0.70, 0.80], np.float32)
"""Into which the ground fades."""

HAZE_M = 30.0
"""Distance at which a third of the ground's own light is left."""

SHADOW_REACH_M = 5.5
"""Largest distance from the robot of a shadow that it throws."""

BEYOND_M = np.float32(1000.0)
"""Depth of a ray that meets nothing."""


def still(
    frames: pa.Table,
    terrain: Terrain | None,
    step: int,
    size: tuple[int, int] = STILL_SIZE,
    sizes: Sizes = USUAL,
) -> Picture:
    """Picture [h, w, 3] of row `step` of an episode's frames on its ground (None: flat).

    ConfigError if the episode has no such row.
    """
    _check_steps(frames, [step])
    return _draw(scenes.build(frames, terrain, [step], sizes), step, size, STILL_SAMPLES)


def snapshots(frames: pa.Table, terrain: Terrain | None, steps: Sequence[int], sizes: Sizes = USUAL) -> Picture:
    """Pictures of several rows in one, from left to right and from top to bottom. ConfigError as for `still`."""
    _check_steps(frames, steps)
    scene = scenes.build(frames, terrain, steps, sizes)
    columns = min(len(steps), STRIP_COLUMNS)
    width, height = PANEL_SIZE[0] + STRIP_GAP, PANEL_SIZE[1] + STRIP_GAP
    sheet = np.full((-(-len(steps) // columns) * height - STRIP_GAP, columns * width - STRIP_GAP, 3), 255, np.uint8)
    for number, step in enumerate(steps):
        top, left = number // columns * height, number % columns * width
        sheet[top : top + PANEL_SIZE[1], left : left + PANEL_SIZE[0]] = _draw(scene, step, PANEL_SIZE, STILL_SAMPLES)
    return sheet


def film(
    frames: pa.Table,
    terrain: Terrain | None,
    path: Path,
    progress: Progress | None = None,
    sizes: Sizes = USUAL,
) -> None:
    """Write all rows as an mp4 film in real time, ten pictures a second; `progress(done, total)` follows them."""
    steps = range(frames.num_rows)
    scene = scenes.build(frames, terrain, steps, sizes)
    writer = imageio_ffmpeg.write_frames(
        str(path),
        FILM_SIZE,
        fps=FRAMES_PER_S,
        codec="libx264",
        quality=None,
        macro_block_size=2,
        output_params=["-crf", "20", "-movflags", "+faststart", "-f", "mp4"],
    )
    writer.send(None)
    threads = os.cpu_count() or 1
    try:
        with ThreadPoolExecutor(threads) as pool:
            for start in range(0, len(steps), 4 * threads):
                batch = steps[start : start + 4 * threads]
                for step, picture in zip(
                    batch, pool.map(lambda s: _draw(scene, s, FILM_SIZE, FILM_SAMPLES), batch), strict=True
                ):
                    writer.send(picture)
                    if progress is not None:
                        progress(step + 1, len(steps))
    finally:
        writer.close()


def check_place(out: Path) -> None:
    """ConfigError for a file of another suffix than those of films and pictures, or in a folder that is missing."""
    if out.suffix not in (".png", ".mp4"):
        raise ConfigError(f"cannot write {out}: found the suffix '{out.suffix}'; allowed: .png (picture), .mp4 (film)")
    if not out.parent.is_dir():
        raise ConfigError(f"cannot write {out}: there is no folder {out.parent}; create it, or choose another")


def render(
    frames: pa.Table,
    terrain: Terrain | None,
    out: Path,
    sizes: Sizes = USUAL,
    *,
    step: int | None = None,
    strip: int | None = None,
    progress: Progress | None = None,
) -> None:
    """Write a film (`out` ends in .mp4) or a picture (.png) of an episode's frames on its ground (None: flat).

    A picture shows row `step`, the middle one by default, or `strip` rows spread evenly over the episode. The file
    appears whole or not at all. ConfigError for another suffix, a missing folder, a row that the episode does not have,
    or options that do not go together.
    """
    rows = frames.num_rows
    check_place(out)
    if (step is not None) + (strip is not None) + (out.suffix == ".mp4") > 1:
        raise ConfigError(f"{out}: a film, one step and a strip exclude each other; give --step or --strip, with .png")
    if strip is not None and not 1 <= strip <= rows:
        raise ConfigError(f"a strip shows 1 to {rows} rows of this episode, found {strip}; choose fewer")
    draft = durable.hidden(out)
    try:
        if out.suffix == ".mp4":
            film(frames, terrain, draft, progress, sizes)
        else:
            if strip is None:
                chosen = rows // 2 if step is None else step
                picture = still(frames, terrain, chosen, sizes=sizes)
            else:
                spread = np.linspace(0, rows - 1, strip).round().astype(int).tolist()
                picture = snapshots(frames, terrain, spread, sizes)
            Image.fromarray(picture).save(draft, format="png")
        durable.publish(out)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror or error}; choose a folder you may write to") from error
    finally:
        with suppress(OSError):  # of a folder that cannot be written nothing can be removed either
            draft.unlink(missing_ok=True)


def _check_steps(frames: pa.Table, steps: Sequence[int]) -> None:
    for step in steps:
        if not 0 <= step < frames.num_rows:
            raise ConfigError(f"the episode has no step {step}; allowed: 0 to {frames.num_rows - 1}")


def _draw(scene: Scene, step: int, size: tuple[int, int], samples: int) -> Picture:
    """The finished picture [h, w, 3], each pixel the mean of samples x samples rays."""
    width, height = size
    camera = scene.camera(step, (width * samples, height * samples))
    depth = cast_ground(camera, scene.landscape.height, scene.landscape.creases)
    rods = scene.rods(step)
    rows, columns, rod, depths = cast_rods(camera, rods.a, rods.b, rods.r, depth)
    rod_light = _rod_light(scene, camera, rods[rod], camera.points(rows, columns, depths))
    casting = rods[rods.part != TRACK]
    shadow = cast_shadow(scene.sun, float(scene.nodes[step, :, 2].min()), casting.a, casting.b, casting.r)
    light = np.empty((height, width, 3), np.float32)
    for top in range(0, height, BAND_ROWS):
        band = slice(top * samples, min(top + BAND_ROWS, height) * samples)
        rays = _ground_light(scene, step, camera, shadow, band, np.minimum(depth[band], BEYOND_M))
        first, last = np.searchsorted(rows, (band.start, band.stop))
        rays[rows[first:last] - band.start, columns[first:last]] = rod_light[first:last]
        np.minimum(rays, 1, out=rays)
        parts = [rays[i::samples, j::samples] for i in range(samples) for j in range(samples)]
        light[top : top + BAND_ROWS] = sum(parts[1:], parts[0]) / len(parts)
    picture = Image.fromarray((255 * light ** (1 / 2.2)).astype(np.uint8))
    speed = scene.forward_speed_m_per_s[step]
    _write_caption(picture, f"{scene.time_s[step]:.1f} s     {speed:+.2f} m/s to the waypoint")
    return np.asarray(picture)


def _write_caption(picture: Image.Image, text: str) -> None:
    size = max(18, round(picture.height * 0.037))
    ImageDraw.Draw(picture).text(
        (size, picture.height - size),
        text,
        font=ImageFont.load_default(size),
        anchor="ls",
        fill=(255, 255, 255),
        stroke_width=max(1, size // 13),
        stroke_fill=(30, 34, 40),
    )


def _ground_light(scene: Scene, step: int, camera: Camera, shadow: ShadowMap, band: slice, depth: Floats) -> Floats:
    """Light of the ground in the rows `band`, [rows, w, 3]."""
    points = [p.ravel() for p in camera.points(band, slice(None), depth)]
    distance = depth.ravel()
    pixel = distance * np.float32(camera.pixel)
    direct, ambient, light = scene.landscape.shade(points[0], points[1], points[2], pixel)
    _shade(scene.com[step], shadow, points, direct)
    _paint(scene, step, points[0], points[1], pixel, light)
    light *= direct[:, None] * SUN + ambient[:, None] * SKY
    light -= HORIZON
    light *= np.exp(-((distance / HAZE_M) ** 2))[:, None]
    light += HORIZON
    return light.reshape(*depth.shape, 3)


def _shade(com: Array, shadow: ShadowMap, points: Sequence[Floats], direct: Floats) -> None:
    """Darken the sunlight `direct` on ground points in the shadow of the robot."""
    plane, corner, lit = shadow
    across, along = (np.abs(p - float(c)) for p, c in zip(points[:2], com[:2], strict=True))
    near = np.flatnonzero((across < SHADOW_REACH_M) & (along < SHADOW_REACH_M))
    i, j = (
        (sum(p[near] * c for p, c in zip(points, axis, strict=True)) - first) / SHADOW_TEXEL_M
        for axis, first in zip(plane.T.tolist(), corner.tolist(), strict=True)
    )
    inside = (i >= 0) & (j >= 0) & (i <= lit.shape[0] - 1) & (j <= lit.shape[1] - 1)
    direct[near[inside]] *= look_up([lit], i[inside], j[inside])[0]


def _paint(scene: Scene, step: int, x: Floats, y: Floats, pixel: Floats, albedo: Floats) -> None:
    """Paint the waypoint's disc and the support triangle onto the ground's albedo, as seen from above."""
    corners = scene.nodes[step, FACES[scene.face[step]], :2]
    middle = corners.mean(axis=0)
    reach = float(np.hypot(*(corners - middle).T).max())
    for centre, radius, triangle, colour, fill in (
        (scene.waypoint[step], scene.sizes.waypoint_radius_m, None, WAYPOINT_COLOUR, 0.3),
        (middle, reach, corners - middle, TRIANGLE_COLOURS[scene.kind[step]], 0.55),
    ):
        across, along = x - float(centre[0]), y - float(centre[1])
        near = np.flatnonzero((np.abs(across) < radius + 0.1) & (np.abs(along) < radius + 0.1))
        across, along = across[near], along[near]
        outside = np.hypot(across, along) - radius if triangle is None else _outside(triangle, across, along)
        blur = 1.5 * np.maximum(pixel[near], 0.003)
        line = np.clip(0.5 - (np.abs(outside) - 0.018) / blur, 0, 1)
        cover = np.maximum(fill * np.clip(0.5 - outside / blur, 0, 1), line)[:, None]
        albedo[near] += cover * (colour - albedo[near])


def _outside(corners: Array, x: Floats, y: Floats) -> Floats:
    """Distance (m) of points from the edges of the triangle `corners` [3, 2], negative inside."""
    edges = np.roll(corners, -1, axis=0) - corners
    turn = edges[0, 0] * edges[1, 1] - edges[0, 1] * edges[1, 0]
    edges *= np.sign(turn) / np.hypot(*edges.T)[:, None]
    sides = zip(corners.tolist(), edges.tolist(), strict=True)
    return np.maximum.reduce([(x - x0) * ey - (y - y0) * ex for (x0, y0), (ex, ey) in sides])


def _rod_light(scene: Scene, camera: Camera, rods: Rods, points: Sequence[Array | Floats]) -> Array:
    """Light [m, 3] of points on the surface of their rods; the track and the flag also glow."""
    place: Array = np.column_stack(points).astype(np.float64)
    axis = rods.b - rods.a
    share = np.clip(((place - rods.a) * axis).sum(axis=1) / (axis**2).sum(axis=1), 0, 1)
    normal = (place - rods.a - share[:, None] * axis) / rods.r[:, None]
    view = camera.eye - place
    half = view / np.linalg.norm(view, axis=1, keepdims=True) + scene.sun
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lambert = np.clip(normal @ scene.sun, 0, 1)
    polished = ~np.isin(rods.part, (TRACK, CABLE, POLE)) & (lambert > 0)
    shine = 0.5 * np.clip((normal * half).sum(axis=1), 0, 1) ** 40 * polished
    glow = np.where(rods.part == TRACK, 0.4, 0.0)[:, None]
    lit = lambert[:, None] * SUN + (0.65 + 0.35 * normal[:, 2])[:, None] * SKY
    return ROD_COLOURS[rods.part] * (lit * (1 - glow) + glow) + shine[:, None] * SUN

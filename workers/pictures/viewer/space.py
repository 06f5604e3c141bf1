"""Bodies in space: robot, ground, track, waypoint and support triangle, in the frame of the world (m)."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import rerun as rr
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.workers.pictures import scene
from t6gps.workers.pictures.motion import Motion
from t6gps.workers.pictures.viewer import colours
from t6gps.workers.pictures.viewer.ground_mesh import around
from t6gps.workers.pictures.viewer.rows import Rows
from t6gps.workers.pictures.viewer.world import World
from t6gps.workers.robot.recorded import numbers
from t6gps.workers.robot.topology import BAR_LENGTH_M, BARS_N, CABLES, CABLES_N, FACES, NODES_N

Array = NDArray[np.float64]

NODE_RADIUS_PER_BAR = 1.25
"""Of the balls at the ends of bars, so that they are seen."""

CIRCLE_CORNERS_N = 64


def log_robot(rows: Rows, moved: Motion, world: World) -> None:
    """Bars as capsules, their ends, and cables in the colours of their tensions."""
    n, radius_m = len(moved.com), world.robot.bar_radius_m
    bars = rr.Capsules3D(
        lengths=[BAR_LENGTH_M] * BARS_N,
        radii=[radius_m] * BARS_N,
        translations=[(0.0, 0.0, -BAR_LENGTH_M / 2)] * BARS_N,
        colors=[colours.BAR_COLOUR] * BARS_N,
        fill_mode=rr.components.FillMode.Solid,
    )
    rows.log("world/robot/bars", bars)
    positions, orientations = (
        schema.array(rows.frames, f"bar_{part}").reshape(-1, k) for part, k in (("positions", 3), ("orientations", 4))
    )
    poses = rr.InstancePoses3D.columns(translations=positions, quaternions=orientations)
    rows.send("world/robot/bars", poses.partition([BARS_N] * n))
    balls = rr.Points3D.from_fields(radii=[NODE_RADIUS_PER_BAR * radius_m], colors=[colours.NODE_COLOUR])
    rows.log("world/robot/nodes", balls)
    nodes = rr.Points3D.columns(positions=moved.nodes.reshape(-1, 3))
    rows.send("world/robot/nodes", nodes.partition([NODES_N] * n))
    rows.log("world/robot/cables", rr.LineStrips3D.from_fields(radii=[scene.CABLE_RADIUS_M]))
    lines = rr.LineStrips3D.columns(
        strips=moved.attached[:, CABLES].reshape(-1, 2, 3).astype(np.float32),
        colors=colours.of_tensions(moved.tensions.ravel(), world.brightest_n),
    )
    rows.send("world/robot/cables", lines.partition([CABLES_N] * n))


def log_support_triangle(rows: Rows, moved: Motion) -> None:
    """The triangle under the centre of mass in the colour of its kind, and the centre of mass."""
    kind, face = schema.array(rows.frames, "kind"), schema.array(rows.frames, "face")
    rows.log("world/robot/support_triangle", rr.Mesh3D.from_fields(triangle_indices=[(0, 1, 2)]))
    corners = np.take_along_axis(moved.nodes, FACES[face][:, :, None], axis=1)
    triangles = rr.Mesh3D.columns(
        vertex_positions=corners.reshape(-1, 3), vertex_colors=np.repeat(colours.KIND_COLOURS[kind], 3)
    )
    rows.send("world/robot/support_triangle", triangles.partition([3] * len(corners)))
    point = rr.Points3D.from_fields(radii=[1.5 * scene.TRACK_RADIUS_M], colors=[colours.YELLOW])
    rows.log("world/com", point)
    com = np.column_stack([numbers(rows.frames, f"com_{axis}_m") for axis in "xyz"])
    rows.send("world/com", rr.Points3D.columns(positions=com))


def log_surroundings(rows: Rows, moved: Motion, world: World) -> None:
    """The ground near the track, the track laid on it, and the waypoint whenever it is another."""
    path = moved.com[:, :2]
    mesh = around(world.terrain, path)
    ground = rr.Mesh3D(
        vertex_positions=mesh.corners.reshape(-1, 3),
        vertex_normals=np.repeat(mesh.normals, 3, axis=0),
        vertex_colors=colours.of_light(mesh.light.reshape(-1, 3)),
    )
    rows.log("world/ground", ground)
    track = scene.laid(path, world.height)
    rows.log("world/track", rr.LineStrips3D([track], radii=scene.TRACK_RADIUS_M, colors=[colours.YELLOW]))
    rows.log("world/waypoint", rr.LineStrips3D.from_fields(radii=[scene.POLE_RADIUS_M], colors=[colours.YELLOW]))
    places = waypoints(rows.frames)
    changes = np.flatnonzero(np.r_[True, (np.diff(places, axis=0) != 0).any(axis=1)])
    marks = [strip for row in changes for strip in _mark(places[row], world)]
    rows.send("world/waypoint", rr.LineStrips3D.columns(strips=marks).partition([2] * len(changes)), changes)


def waypoints(frames: pa.Table) -> Array:
    """Place of the active waypoint [T + 1, 2] (m)."""
    return np.column_stack([numbers(frames, f"waypoint_{axis}_m") for axis in "xy"])


def _mark(place: Array, world: World) -> tuple[Array, Array]:
    """The circle in which a waypoint is reached, laid on the ground, and the pole in its middle."""
    turn = np.linspace(0, 2 * np.pi, CIRCLE_CORNERS_N + 1)
    circle = place + world.waypoint_radius_m * np.column_stack([np.cos(turn), np.sin(turn)])
    foot = np.array([*place, world.height(*place)])
    return scene.laid(circle, world.height), np.array([foot, foot + (0.0, 0.0, scene.FLAG_HEIGHT_M)])

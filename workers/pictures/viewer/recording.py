"""A stored episode as a recording for the Rerun viewer: bodies in space, and the numbers of each row.

Time runs over two lines, `step` (the control step) and `time` (since the start). Lengths are in m.

    world/robot/bars               capsules at the stored positions and orientations, bit for bit
    world/robot/nodes              ends of the bars
    world/robot/cables             lines in the colours of their tensions
    world/robot/support_triangle   the triangle under the centre of mass, in the colour of its kind
    world/com                      centre of mass
    world/track                    its path, laid on the ground
    world/waypoint                 the circle in which the waypoint is reached, and a pole
    world/ground                   the facets of the ground near the path
    frames/NAME                    the column NAME of the table `frames`, bit for bit
    cables/tension_n, command_m, rest_length_m   24 numbers of each row, in the cables' own order
    segments/kind, class, stuck    states, logged when they change
    about                          the episode's summary, and what the colours mean

The episode's summary is the property `episode` of the recording, so that a catalogue lists and sorts by it.
"""

from __future__ import annotations

import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb

from t6gps.storage import schema
from t6gps.storage.records import Episode
from t6gps.workers.pictures import scene
from t6gps.workers.pictures.motion import Motion, of_episode
from t6gps.workers.pictures.viewer import series, space
from t6gps.workers.pictures.viewer.layout import ABOUT, layout
from t6gps.workers.pictures.viewer.rows import Rows
from t6gps.workers.pictures.viewer.world import World

APPLICATION = "t6gps"

EYE_SHARE = 0.7
"""Of the camera's distance in pictures, whose lens is longer than the viewer's."""


def recorded(name: str, episode: Episode, world: World) -> bytes:
    """The content of a .rrd file with an episode, under a name that is unique where files are looked at together."""
    rr.set_strict_mode(True)  # a mistake of ours shall be an error, not a warning and a gap
    stream = rr.RecordingStream(APPLICATION, recording_id=name, send_properties=False)
    memory = stream.memory_recording()
    summary = {key: value for key, value in episode.summary.to_pylist()[0].items() if value is not None}
    moved = of_episode(episode, world.robot)
    stream.send_blueprint(_layout(episode.frames, moved, world))
    stream.send_recording_name(name)
    stream.send_property("episode", rr.AnyValues(**summary))
    rows = Rows(stream, episode.frames)
    rows.log("about", _about(name, summary, world))
    rows.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP)
    space.log_robot(rows, moved, world)
    space.log_support_triangle(rows, moved)
    space.log_surroundings(rows, moved, world)
    series.log_frames(rows)
    series.log_cables(rows, moved)
    series.log_segments(rows, moved)
    stream.flush()
    content: bytes = memory.drain_as_bytes()
    return content


def _layout(frames: pa.Table, moved: Motion, world: World) -> rrb.Blueprint:
    """Views whose eye stands at the start where pictures of the episode are taken from."""
    seen = slice(None, None, max(1, len(moved.com) // 30))
    way = space.waypoints(frames)[seen] - moved.com[seen, :2]
    angle_rad = scene.view_angle(moved.com[seen], moved.nodes[seen], way, world.terrain)
    eye = moved.com[0] + EYE_SHARE * (scene.eyes_at(moved.com[0], angle_rad) - moved.com[0])
    return layout(eye, moved.com[0], world.terrain is None)


def _about(name: str, summary: dict[str, object], world: World) -> rr.TextDocument:
    """A page with the episode's summary."""
    units = {field.name: field.metadata[b"unit"].decode() for field in schema.EPISODES}
    lines = [
        f"| {key} | {value:.4g} {units[key]} |" if isinstance(value, float) else f"| {key} | {value} |"
        for key, value in summary.items()
    ]
    text = ABOUT.format(name=name, rows="\n".join(lines), brightest_n=world.brightest_n)
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)

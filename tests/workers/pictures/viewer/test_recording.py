"""Laws of recordings for the Rerun viewer: read back through Rerun's catalogue, they are what was stored."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import rerun as rr
from numpy.typing import NDArray
from rerun.catalog import DatasetEntry
from rough_walk import walked

from t6gps.storage import fields, schema
from t6gps.storage.records import Episode
from t6gps.workers.ground.ground import ground
from t6gps.workers.pictures.motion import motion
from t6gps.workers.pictures.viewer import colours
from t6gps.workers.pictures.viewer.recording import recorded
from t6gps.workers.pictures.viewer.world import World
from t6gps.workers.robot.neutral import neutral_state
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.symmetry import CABLES_FROM, EDGE_NAMES, ELEMENTS_N
from t6gps.workers.robot.topology import BAR_LENGTH_M, CABLES, CABLES_N, FACES, KIND_NAMES
from t6gps.workers.settings import RandomisationSettings, RobotSettings, RolloutSettings, TaskSettings, TerrainSettings

Array = NDArray[np.float64]
SETTINGS = RolloutSettings(
    terrain=TerrainSettings(difficulty=0.7),
    task=TaskSettings(waypoint_timeout_s=1.5),
    randomisation=RandomisationSettings(stiffness_spread=0.3),
)
NAME = "walk-7"


@pytest.fixture(scope="module")
def episode() -> Episode:
    """A real one: rough ground, another waypoint every 1.5 s, cables of a stiffness of its own."""
    return walked(SETTINGS)


@pytest.fixture(scope="module")
def world() -> World:
    return World(SETTINGS.robot, ground(SETTINGS.terrain, 5, 0.7), SETTINGS.task.waypoint_radius_m)


@contextmanager
def served(folder: Path, episode: Episode, world: World) -> Iterator[DatasetEntry]:
    """A folder with an episode's recording, as a server of Rerun has it."""
    (folder / f"{NAME}.rrd").write_bytes(recorded(NAME, episode, world))
    with rr.server.Server(host="127.0.0.1", datasets={"walks": folder}) as server:
        client = server.client()  # answers only while somebody holds it
        yield client.get_dataset("walks")


@pytest.fixture(scope="module")
def catalogue(episode: Episode, world: World, tmp_path_factory: pytest.TempPathFactory) -> Iterator[DatasetEntry]:
    with served(tmp_path_factory.mktemp("recordings"), episode, world) as dataset:
        yield dataset


@pytest.fixture(scope="module")
def rows(catalogue: DatasetEntry) -> pa.Table:
    """What the recording has at each step."""
    return catalogue.reader(index="step").to_arrow_table().sort_by("step")


@pytest.fixture(scope="module")
def always(catalogue: DatasetEntry) -> pa.Table:
    """What it has for the whole episode."""
    return catalogue.reader(index=None).to_arrow_table()


def values(table: pa.Table, column: str, *shape: int) -> NDArray[np.generic]:
    """Numbers of a column, without the rows that have none, [-1, *shape]."""
    flat = table[column].combine_chunks()
    while pa.types.is_nested(flat.type):
        flat = flat.flatten()
    return flat.to_numpy(zero_copy_only=False).reshape(-1, *shape)


def at(table: pa.Table, column: str) -> NDArray[np.generic]:
    """Steps at which a column has something."""
    return table.filter(table[column].is_valid())["step"].to_numpy()


def state_of(frames: pa.Table) -> RobotState:
    """Bars of the rows; rest lengths as they stand in the frames, which is canonically."""
    parts = {"positions": 3, "orientations": 4, "velocities": 3, "angular_velocities": 3}
    bars = [np.asarray(schema.array(frames, f"bar_{part}"), float).reshape(-1, 6, n) for part, n in parts.items()]
    return RobotState(np.concatenate(bars, axis=-1), np.asarray(schema.array(frames, "rest_lengths"), float))


def test_both_time_lines_are_those_of_the_frames(rows: pa.Table, episode: Episode) -> None:
    assert rows["step"].to_pylist() == episode.frames["step"].to_pylist()
    nanoseconds = rows["time"].cast(pa.int64()).to_pylist()
    assert nanoseconds == [round(second * 1e9) for second in episode.frames["time_s"].to_pylist()]
    assert rows["step"].to_pylist() == list(range(61))
    assert nanoseconds == [100_000_000 * step for step in range(61)]


@pytest.mark.parametrize(("column", "part"), [("translations", "positions"), ("quaternions", "orientations")])
def test_poses_of_bars_come_back_bit_for_bit(rows: pa.Table, episode: Episode, column: str, part: str) -> None:
    stored = schema.array(episode.frames, f"bar_{part}")
    back = values(rows, f"/world/robot/bars:InstancePoses3D:{column}")
    assert back.dtype == stored.dtype == np.float32
    assert back.tobytes() == stored.tobytes()


def test_every_scalar_column_of_the_frames_comes_back_bit_for_bit(rows: pa.Table, episode: Episode) -> None:
    identity = {"episode_id", "iteration", "policy_version", "step", "time_s"}
    names = {column.name for column in schema.FRAMES if fields.vector_length(column) is None} - identity
    back = {name for name in names if f"/frames/{name}:Scalars:scalars" in rows.column_names}
    assert back == names
    for name in names:
        column, stored = f"/frames/{name}:Scalars:scalars", episode.frames[name]
        assert at(rows, column).tolist() == np.flatnonzero(stored.is_valid()).tolist()
        assert values(rows, column).tobytes() == stored.drop_null().to_numpy().astype(np.float64).tobytes()
    assert episode.frames["exit_edge"].null_count > 0


def test_series_are_named_with_their_units(always: pa.Table) -> None:
    assert values(always, "/frames/cost:SeriesLines:names").tolist() == ["cost (m2/s2)"]


def test_commands_and_rest_lengths_are_the_cables_own(rows: pa.Table, episode: Episode) -> None:
    """Those of the frames are in the order of the canonical frame, which changes with the support triangle."""
    frames = episode.frames
    canonical_from = CABLES_FROM[schema.array(frames, "element")]
    assert len(set(schema.array(frames, "element").tolist())) > 1
    for name, column in (("rest_length_m", "rest_lengths"), ("command_m", "action")):
        own = values(rows, f"/cables/{name}:Scalars:scalars", CABLES_N)
        stored = schema.array(frames, column)
        np.testing.assert_array_equal(np.take_along_axis(own, canonical_from[: len(own)], axis=1), stored)
    assert at(rows, "/cables/command_m:Scalars:scalars").tolist() == list(range(60)), "the last row has no action"


def test_cables_end_at_the_nodes_of_the_bars(rows: pa.Table, episode: Episode) -> None:
    nodes = values(rows, "/world/robot/nodes:Points3D:positions", 12, 3)
    np.testing.assert_array_equal(nodes, state_of(episode.frames).nodes().astype(np.float32))
    strips = values(rows, "/world/robot/cables:LineStrips3D:strips", CABLES_N, 2, 3)
    np.testing.assert_array_equal(strips, nodes[:, CABLES])
    lengths = np.linalg.norm(nodes[:, 0::2] - nodes[:, 1::2], axis=2)
    np.testing.assert_allclose(lengths, BAR_LENGTH_M, atol=1e-5)


def test_tensions_lie_between_slack_and_twice_the_elastic_force(rows: pa.Table, episode: Episode) -> None:
    """The law of the cables, with the stiffness that the episode has drawn."""
    stiffness = episode.summary["cable_stiffness_n_per_m"][0].as_py()
    assert stiffness != SETTINGS.robot.cable_stiffness_n_per_m
    tension = values(rows, "/cables/tension_n:Scalars:scalars", CABLES_N)
    rest = values(rows, "/cables/rest_length_m:Scalars:scalars", CABLES_N)
    first, second = state_of(episode.frames).nodes()[:, CABLES].swapaxes(0, 2).swapaxes(1, 2)
    elastic = stiffness * np.maximum(0, np.linalg.norm(second - first, axis=-1).reshape(-1, CABLES_N) - rest)
    assert (tension >= 0).all()
    assert (tension <= 2 * elastic + 1e-6).all()
    assert (tension[elastic == 0] == 0).all()
    share = tension[elastic > 1] / elastic[elastic > 1]
    assert share.max() == pytest.approx(2, rel=1e-6), "where a cable lengthens fast"


@pytest.mark.parametrize("stiffness", [1000.0, 2000.0])
def test_the_neutral_robot_at_rest_has_its_pretension_in_every_cable(stiffness: float) -> None:
    robot = RobotSettings(cable_stiffness_n_per_m=stiffness)
    state = neutral_state(robot)
    columns = {f"bar_{name.removeprefix('bar_')}": part for name, part in state.parts().items() if "bar" in name}
    columns |= {"rest_lengths": state.rest_lengths, "action": state.rest_lengths}
    frames = pa.table(
        {"element": pa.array(range(ELEMENTS_N), pa.int8())}
        | {
            name: pa.array([part.ravel().tolist()] * ELEMENTS_N, pa.list_(pa.float32()))
            for name, part in columns.items()
        }
    )
    np.testing.assert_allclose(motion(frames, robot).tensions, robot.pretension_n, rtol=1e-3)


def test_cables_have_the_colours_of_their_tensions(rows: pa.Table, world: World) -> None:
    tension = values(rows, "/cables/tension_n:Scalars:scalars")
    drawn = values(rows, "/world/robot/cables:LineStrips3D:colors")
    np.testing.assert_array_equal(drawn, colours.of_tensions(tension, world.brightest_n))


def test_colours_run_from_blue_over_green_to_red_and_stay_there() -> None:
    shown = colours.of_tensions(np.array([60.0, 300.0, 560.0, 600.0, 900.0]), 600.0)
    red, green, blue = (shown >> shift & 0xFF for shift in (24, 16, 8))
    assert np.argmax([red, green, blue], axis=0).tolist() == [2, 1, 0, 0, 0]
    assert shown[3] == shown[4]
    assert (shown & 0xFF == 0xFF).all()


def test_the_support_triangle_follows_its_nodes_in_the_colour_of_its_kind(rows: pa.Table, episode: Episode) -> None:
    nodes = values(rows, "/world/robot/nodes:Points3D:positions", 12, 3)
    corners = values(rows, "/world/robot/support_triangle:Mesh3D:vertex_positions", 3, 3)
    face, kind = schema.array(episode.frames, "face"), schema.array(episode.frames, "kind")
    np.testing.assert_array_equal(corners, np.take_along_axis(nodes, FACES[face][:, :, None], axis=1))
    painted = values(rows, "/world/robot/support_triangle:Mesh3D:vertex_colors", 3)
    assert set(kind.tolist()) == {0, 1}
    np.testing.assert_array_equal(painted, np.repeat(colours.KIND_COLOURS[kind], 3).reshape(-1, 3))


def test_the_ground_is_that_of_the_simulation_and_reaches_beyond_the_track(
    rows: pa.Table, always: pa.Table, world: World
) -> None:
    assert world.terrain is not None
    corners = values(always, "/world/ground:Mesh3D:vertex_positions", 3, 3)
    heights = world.terrain.height(corners[..., 0].astype(float), corners[..., 1].astype(float))
    np.testing.assert_allclose(corners[..., 2], heights, atol=1e-5)
    normals = values(always, "/world/ground:Mesh3D:vertex_normals", 3, 3)
    sides = np.roll(corners, -1, axis=1) - corners
    assert (np.abs((sides * normals).sum(axis=-1)) < 1e-5).all()
    assert (normals[..., 2] > 0).all()
    com = values(rows, "/world/com:Points3D:positions", 3)
    low, high = corners[..., :2].min(axis=(0, 1)), corners[..., :2].max(axis=(0, 1))
    assert (com[:, :2].min(axis=0) - low >= 6).all()
    assert (high - com[:, :2].max(axis=0) >= 6).all()
    (ax, ay), (bx, by) = sides[:, 0, :2].T, sides[:, 1, :2].T
    assert (ax * by - ay * bx).sum() / 2 == pytest.approx(np.prod(high - low), rel=1e-5), "without holes"


def test_the_track_lies_on_the_ground_from_start_to_end(rows: pa.Table, always: pa.Table, world: World) -> None:
    track = values(always, "/world/track:LineStrips3D:strips", 3).astype(float)
    com = values(rows, "/world/com:Points3D:positions", 3)
    np.testing.assert_allclose(track[[0, -1], :2], com[[0, -1], :2], atol=1e-5)
    above = track[:, 2] - world.height(track[:, 0], track[:, 1])
    assert ((above > 0) & (above < 0.02)).all()


def test_a_waypoint_is_a_circle_of_its_radius_on_the_ground_while_it_is_active(
    rows: pa.Table, episode: Episode, world: World
) -> None:
    column = "/world/waypoint:LineStrips3D:strips"
    number = episode.frames["waypoint"].to_numpy()
    steps = at(rows, column)
    assert steps.tolist() == [0, *(np.flatnonzero(np.diff(number)) + 1).tolist()]
    assert len(steps) > 2
    marks = rows.filter(rows[column].is_valid())[column].to_pylist()
    for step, (circle, pole) in zip(steps.tolist(), marks, strict=True):
        place = np.array([episode.frames[f"waypoint_{axis}_m"][step].as_py() for axis in "xy"])
        rim = np.array(circle)
        radii = np.hypot(*(rim[:, :2] - place).T)
        np.testing.assert_allclose(radii, world.waypoint_radius_m, rtol=2e-3)
        np.testing.assert_allclose(rim[:, 2], world.height(rim[:, 0], rim[:, 1]) + 0.01, atol=1e-4)
        np.testing.assert_allclose(np.array(pole)[:, :2], [place, place], atol=1e-5)


def test_segments_begin_where_the_triangle_changes(rows: pa.Table, episode: Episode) -> None:
    face = schema.array(episode.frames, "face")
    begins = [0, *(np.flatnonzero(np.diff(face)) + 1).tolist()]
    assert at(rows, "/segments/class:StateChange:state").tolist() == begins
    names = values(rows, "/segments/class:StateChange:state")
    kinds = schema.array(episode.frames, "kind")[begins].tolist()
    entry, exit_ = (episode.frames[f"{way}_edge"].to_pylist() for way in ("entry", "exit"))
    ends = [(entry[first], exit_[last - 1]) for first, last in pairwise([*begins, len(face)])]
    assert names.tolist() == [
        f"{KIND_NAMES[kind]}: " + " → ".join("..." if edge is None else EDGE_NAMES[kind][edge] for edge in edges)
        for kind, edges in zip(kinds, ends, strict=True)
    ]
    assert ends[0][0] is None, "nobody knows how the first triangle was entered"
    assert ends[-1][1] is None
    assert len([edges for edges in ends if None not in edges]) > 1


def test_a_robot_that_stays_is_stuck_from_the_second_second_on(episode: Episode, world: World, tmp_path: Path) -> None:
    first = episode.frames.slice(0, 1)
    still = {"step": pa.array(range(15), pa.int32()), "time_s": pa.array([0.1 * step for step in range(15)])}
    frames = pa.concat_tables([first] * 15)
    for name, column in still.items():
        frames = frames.set_column(frames.schema.get_field_index(name), frames.schema.field(name), column)
    with served(tmp_path, Episode(frames, episode.summary), world) as dataset:
        rows = dataset.reader(index="step").to_arrow_table().sort_by("step")
    assert at(rows, "/segments/stuck:StateChange:state").tolist() == [0, 10]
    assert values(rows, "/segments/stuck:StateChange:state").tolist() == ["moving", "stuck"]


def test_the_catalogue_lists_episodes_with_their_summaries(catalogue: DatasetEntry, episode: Episode) -> None:
    (line,) = catalogue.segment_table().to_arrow_table().to_pylist()
    assert line["rerun_segment_id"] == NAME
    summary = {name: value for name, value in episode.summary.to_pylist()[0].items() if value is not None}
    assert {name: line[f"property:episode:{name}"] for name in summary} == {k: [v] for k, v in summary.items()}


def test_flat_ground_is_level_and_reaches_as_far(episode: Episode, tmp_path: Path) -> None:
    with served(tmp_path, episode, World(SETTINGS.robot, None, 1.0)) as dataset:
        always = dataset.reader(index=None).to_arrow_table()
    corners = values(always, "/world/ground:Mesh3D:vertex_positions", 3)
    assert (corners[:, 2] == 0).all()
    com = np.array([episode.frames[f"com_{axis}_m"].to_numpy() for axis in "xy"])
    assert (com.min(axis=1) - corners[:, :2].min(axis=0) >= 6).all()
    assert (corners[:, :2].max(axis=0) - com.max(axis=1) >= 6).all()


def test_a_recording_takes_little_room(episode: Episode, world: World) -> None:
    assert len(recorded(NAME, episode, world)) < 700_000

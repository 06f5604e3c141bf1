"""Pieces of recorded episodes in the simulator again: as they were, under other actions, or under a policy.

A row of `frames` holds the whole state, so the robot can be put there again. What it does then under the recorded
actions is what is recorded, to the rounding of the table.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.workers.episode import policy, streams
from t6gps.workers.episode.randomisation import draw
from t6gps.workers.episode.recording import canonical_vectors
from t6gps.workers.episode.streams import Stream
from t6gps.workers.ground.ground import ground
from t6gps.workers.ground.terrain import Terrain
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.engine import Engine
from t6gps.workers.physics.observer import observe, steer, survey
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter
from t6gps.workers.robot.symmetry import CABLES_FROM, NODES_FROM, frame_yaw, world_map
from t6gps.workers.robot.topology import BARS_N, CABLES_N, FACE_KINDS
from t6gps.workers.settings import RobotSettings, RolloutSettings

Array = NDArray[np.float64]
BARS = ("bar_positions", "bar_orientations", "bar_velocities", "bar_angular_velocities")
"""Columns of `frames` that hold the bars, side by side as in `RobotState.bars`."""


@dataclass(frozen=True)
class Recorded:
    """An episode of T control steps as it is stored, and the world that it was recorded in.

    robot, ground, delay_steps   as its plan and the run's settings say; ground is None for the plane
    state       of all rows [T + 1]
    face, element, entry_edge    of the support triangles of all rows [T + 1]; an entry edge of NaN is none
    action      canonical commanded rest lengths [T, 24] (m)
    waypoint    places of the active waypoints [T + 1, 2] (m)
    """

    robot: RobotSettings
    ground: Terrain | None
    delay_steps: int
    state: RobotState
    face: NDArray[np.int64]
    element: NDArray[np.int64]
    entry_edge: Array
    action: Array
    waypoint: Array

    def frame(self, row: int) -> SupportFrame:
        """The support frame of a row."""
        kind, edge = int(FACE_KINDS[self.face[row]]), self.entry_edge[row]
        return SupportFrame(int(self.face[row]), kind, int(self.element[row]), None if np.isnan(edge) else int(edge))


def recorded(episode: Episode, settings: RolloutSettings) -> Recorded:
    """An episode of the tables, in the world of its run's settings."""
    frames, plan = episode.frames, episode.summary.to_pylist()[0]
    robot, delay_steps = draw(settings.robot, settings.randomisation, streams.generator(plan["seed"], Stream.ROBOT))
    parts = [_numbers(frames, name).reshape(frames.num_rows, BARS_N, -1) for name in BARS]
    element = _numbers(frames, "element").astype(np.int64)
    rest_lengths = np.empty((len(element), CABLES_N))
    np.put_along_axis(rest_lengths, CABLES_FROM[element], _numbers(frames, "rest_lengths"), axis=1)
    return Recorded(
        robot=robot,
        ground=ground(settings.terrain, plan["terrain_seed"], plan["terrain_difficulty"]),
        delay_steps=delay_steps,
        state=RobotState(np.concatenate(parts, axis=-1), rest_lengths),
        face=_numbers(frames, "face").astype(np.int64),
        element=element,
        entry_edge=_numbers(frames, "entry_edge"),
        action=_numbers(frames, "action"),
        waypoint=np.stack([_numbers(frames, f"waypoint_{axis}_m") for axis in "xy"], axis=1),
    )


def _numbers(frames: pa.Table, name: str) -> Array:
    return np.asarray(schema.array(frames, name), dtype=np.float64)


def staged(
    episodes: Iterable[Recorded], make: Callable[[RobotSettings], Engine] = PyBulletEngine
) -> Iterator[tuple[Recorded, Engine]]:
    """Each episode with a simulator of its robot on its ground, which is good until the next one is asked for."""
    engine: Engine | None = None
    try:
        for episode in episodes:
            if engine is None or engine.robot != episode.robot:
                if engine is not None:
                    engine.close()
                engine = make(episode.robot)
            engine.set_ground(episode.ground)
            yield episode, engine
    finally:
        if engine is not None:
            engine.close()


def commanded(engine: Engine, episode: Recorded, first: int, actions: Array) -> RobotState:
    """States [steps] after the control steps from row `first` on, under canonical actions [steps, 24] (m).

    An action is in the labels of the recorded row of its step. UnsoundStateError where a state is not sound.
    """
    _start(engine, episode, first)
    delayed = _on_their_way(episode, first)
    states = []
    for row, action in enumerate(actions, first):
        delayed.append(_in_world(action, episode.element[row]))
        states.append(engine.control_step(delayed.popleft()))
    return _stacked(states)


def followed(
    engine: Engine, episode: Recorded, first: int, action: Array, snapshot: PolicySnapshot, steps: int
) -> RobotState:
    """States [steps] after the control steps from row `first` on: one canonical action [24] (m), then a policy.

    The policy acts without any noise, towards the direction that the waypoint has in row `first`. UnsoundStateError
    where a state is not sound.
    """
    act, robot = policy.ready(snapshot), episode.robot
    _start(engine, episode, first)
    delayed, frame = _on_their_way(episode, first), episode.frame(first)
    way = episode.waypoint[first] - episode.state.com[first, :2]
    target = tuple((way / np.hypot(*way)).tolist())
    command, states = _in_world(action, frame.element), []
    for _ in range(steps):
        delayed.append(command)
        state = engine.control_step(delayed.popleft())
        states.append(state)
        face = survey(state)[0]
        frame = frame if face == frame.face else enter(face, frame, state)
        _, observation = observe(state, frame, target, snapshot.offset_m)
        _, command, _ = steer(
            act(observation), np.zeros(CABLES_N), frame.element, robot.shortest_command_m, robot.longest_command_m
        )
    return _stacked(states)


def canonical(state: RobotState, face: int, element: int) -> dict[str, Array]:
    """Canonical columns of `frames` of one state, as if it stood on a support triangle with that element."""
    yaw = frame_yaw(state.nodes(), face, element)
    maps, nodes_from = world_map(element, yaw)[None], NODES_FROM[element][None]
    velocity = state.com_velocity
    return {
        "com_velocity": maps[0] @ velocity,
        "nodes": canonical_vectors((state.nodes() - state.com)[None], maps, nodes_from).ravel(),
        "node_velocities": canonical_vectors((state.node_velocities() - velocity)[None], maps, nodes_from).ravel(),
        "rest_lengths": state.rest_lengths[CABLES_FROM[element]],
    }


def _start(engine: Engine, episode: Recorded, row: int) -> None:
    engine.reset(RobotState(episode.state.bars[row], episode.state.rest_lengths[row]))


def _on_their_way(episode: Recorded, first: int) -> deque[Array]:
    """Commands that were given before row `first` and act from it on; before the first one the winches held."""
    rows = range(first - episode.delay_steps, first)
    held = episode.state.rest_lengths[0]
    return deque(held if row < 0 else _in_world(episode.action[row], episode.element[row]) for row in rows)


def _in_world(action: Array, element: int) -> Array:
    command = np.empty(CABLES_N)
    command[CABLES_FROM[element]] = action
    return command


def _stacked(states: list[RobotState]) -> RobotState:
    bars, rest_lengths = zip(*((state.bars, state.rest_lengths) for state in states), strict=True)
    return RobotState(np.stack(bars), np.stack(rest_lengths))

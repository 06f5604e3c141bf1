"""Recorded episodes once more, and what comes of other actions on the way.

An episode is run again from its plan, up to a row and beyond; on the way branches leave it. The recorded row would not
do: it holds the state of the robot, but not the contacts that Bullet keeps. On the plane those do not matter, on rough
ground one piece in four goes another way without them.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.episode import policy, streams
from t6gps.workers.episode.randomisation import draw
from t6gps.workers.episode.recording import canonical_vectors
from t6gps.workers.episode.rollout import controlled
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.episode.streams import Stream
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.physics.observer import observe, steer, survey
from t6gps.workers.robot.recorded import numbers, states
from t6gps.workers.robot.state import RobotState
from t6gps.workers.robot.support import SupportFrame, enter
from t6gps.workers.robot.symmetry import CABLES_FROM, NODES_FROM, frame_yaw, world_map
from t6gps.workers.robot.topology import CABLES_N, FACE_KINDS
from t6gps.workers.settings import RolloutSettings

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Recorded:
    """An episode of T control steps as it is stored, its plan, and the settings with the robot of this episode.

    state       of all rows [T + 1]
    face, element, entry_edge    of the support triangles of all rows [T + 1]; an entry edge of NaN is none
    action      canonical commanded rest lengths [T, 24] (m)
    waypoint    places of the active waypoints [T + 1, 2] (m)
    """

    plan: EpisodePlan
    settings: RolloutSettings
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


def recorded(episode: Episode, plan: EpisodePlan, settings: RolloutSettings) -> Recorded:
    """An episode of the tables, by its plan and the settings of its run."""
    frames = episode.frames
    robot, delay_steps = draw(settings.robot, settings.randomisation, streams.generator(plan.seed, Stream.ROBOT))
    return Recorded(
        plan=plan,
        settings=settings.model_copy(update={"robot": robot}),
        delay_steps=delay_steps,
        state=states(frames),
        face=numbers(frames, "face").astype(np.int64),
        element=numbers(frames, "element").astype(np.int64),
        entry_edge=numbers(frames, "entry_edge"),
        action=numbers(frames, "action"),
        waypoint=np.stack([numbers(frames, f"waypoint_{axis}_m") for axis in "xy"], axis=1),
    )


def staged(episodes: Iterable[Recorded]) -> Iterator[tuple[Recorded, PyBulletEngine]]:
    """Each episode with a simulator of its robot, which is good until the next one is asked for."""
    engine: PyBulletEngine | None = None
    try:
        for episode in episodes:
            if engine is None or engine.robot != episode.settings.robot:
                if engine is not None:
                    engine.close()
                engine = PyBulletEngine(episode.settings.robot)
            yield episode, engine
    finally:
        if engine is not None:
            engine.close()


Visit = Callable[[int, Callable[[], None]], None]
"""Called in a row of an episode; its second argument brings the simulator back to that row."""


def revisited(
    engine: PyBulletEngine, episode: Recorded, snapshot: PolicySnapshot, rows: Collection[int], visit: Visit
) -> None:
    """Run an episode again under the policy that acted in it, and let `visit` branch off in some of its rows.

    After a branch Bullet may solve contacts in another order, and the episode goes on otherwise. Rows in which the
    robot is not as recorded to the last bit are left to another run of the episode. They are passed over when none of
    them is as recorded: what made the run was another build.
    """
    act, left = policy.ready(snapshot), set(rows)
    bars = episode.state.bars.astype(np.float32)  # as the table has it

    def control(running: RunningEpisode, row: int) -> Array:
        if row in left and row < len(bars) and np.array_equal(running.state.bars.astype(np.float32), bars[row]):
            with engine.branching() as back:
                visit(row, back)
            left.remove(row)
        return act(running.observation)

    before_n = 0
    while left and before_n != len(left):
        before_n = len(left)
        controlled(
            engine, episode.settings, episode.plan, control, snapshot.version, snapshot.offset_m, episode.delay_steps
        )


def commanded(engine: PyBulletEngine, episode: Recorded, first: int, actions: Array) -> RobotState:
    """States [steps] after the control steps from row `first` on, under canonical actions [steps, 24] (m).

    The engine is in that row; an action is in the labels of the recorded row of its step. UnsoundStateError where a
    state is not sound.
    """
    delayed, states = _on_their_way(episode, first), []
    for row, action in enumerate(actions, first):
        delayed.append(_in_world(action, episode.element[row]))
        states.append(engine.control_step(delayed.popleft()))
    return _stacked(states)


def followed(
    engine: PyBulletEngine, episode: Recorded, first: int, action: Array, snapshot: PolicySnapshot, steps: int
) -> RobotState:
    """States [steps] after the control steps from row `first` on: one canonical action [24] (m), then a policy.

    The policy acts without any noise, towards the direction that the waypoint has in row `first`. Otherwise as
    `commanded`.
    """
    act, robot = policy.ready(snapshot), episode.settings.robot
    delayed, frame = _on_their_way(episode, first), episode.frame(first)
    x, y = episode.waypoint[first] - episode.state.com[first, :2]
    target = float(x / np.hypot(x, y)), float(y / np.hypot(x, y))
    command, states = _in_world(action, frame.element), []
    for _ in range(steps):
        delayed.append(command)
        state = engine.control_step(delayed.popleft())
        states.append(state)
        face = survey(state)[0]
        frame = frame if face == frame.face else enter(face, frame, state)
        mean = act(observe(state, frame, target, snapshot.offset_m)[1])
        _, command, _ = steer(
            mean, np.zeros(CABLES_N), frame.element, robot.shortest_command_m, robot.longest_command_m
        )
    return _stacked(states)


def canonical(state: RobotState, face: int, element: int) -> dict[str, Array]:
    """Canonical columns of `frames` of one state, as if it stood on a support triangle with that element."""
    maps, nodes_from = world_map(element, frame_yaw(state.nodes(), face, element))[None], NODES_FROM[element][None]
    velocity = state.com_velocity
    return {
        "com_velocity": maps[0] @ velocity,
        "nodes": canonical_vectors((state.nodes() - state.com)[None], maps, nodes_from).ravel(),
        "node_velocities": canonical_vectors((state.node_velocities() - velocity)[None], maps, nodes_from).ravel(),
        "rest_lengths": state.rest_lengths[CABLES_FROM[element]],
    }


def _on_their_way(episode: Recorded, first: int) -> deque[Array]:
    """Commands that were given before row `first` and act from it on; before the first one the winches held."""
    rows, held = range(first - episode.delay_steps, first), episode.state.rest_lengths[0]
    return deque(held if row < 0 else _in_world(episode.action[row], episode.element[row]) for row in rows)


def _in_world(action: Array, element: int) -> Array:
    command = np.empty(CABLES_N)
    command[CABLES_FROM[element]] = action
    return command


def _stacked(states: list[RobotState]) -> RobotState:
    return RobotState(np.stack([state.bars for state in states]), np.stack([state.rest_lengths for state in states]))

"""A small hybrid world whose dynamics are linear between crossings, recorded exactly as the robot's workers record."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from numpy.typing import NDArray

from t6gps.learner.algorithm.features import Canonical
from t6gps.learner.algorithm.segments import Segments, classify
from t6gps.learner.episodes import Episodes
from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.learner.policy import initial
from t6gps.learner.port import Task
from t6gps.learner.rows import Rows
from t6gps.learner.settings import LearnerSettings, ReducedState
from t6gps.storage import fields, schema
from t6gps.storage.records import PolicySnapshot

Array = NDArray[np.float64]

OFFSET_M, SCALE_M = 1.088, 0.2
NOISE_STD_M = 0.1
"""Of every episode, unless a test says otherwise."""


def frames_table(columns: dict[str, Any], rows: int) -> pa.Table:
    """A table that follows FRAMES; columns that are not given hold zeros."""
    arrays = []
    for field in schema.FRAMES:
        length, values = fields.vector_length(field), columns.get(field.name)
        if values is None:
            values = [0] * rows if length is None else np.zeros((rows, length), dtype=np.float32)
        arrays.append(pa.array(list(values), type=field.type))
    return fields.check(pa.Table.from_arrays(arrays, schema=schema.FRAMES), schema.FRAMES, "test episode")


def stay_table(stays: list[tuple[int, int, int | None, int | None]]) -> pa.Table:
    """One episode of stays (face, rows, entry, exit), kind 0; the last row has no action."""
    face = [face for face, rows, _, _ in stays for _ in range(rows)]
    entry = [entry for _, rows, entry, _ in stays for _ in range(rows)]
    exit_ = [exit_ if row == rows - 1 else None for _, rows, _, exit_ in stays for row in range(rows)]
    actions = [np.zeros(24)] * (len(face) - 1) + [None]
    columns = {"face": face, "entry_edge": entry, "exit_edge": exit_, "action": actions, "action_mean": actions}
    return frames_table(columns, len(face))


class HybridWorld:
    """Two kinds of support triangle with linear dynamics each; crossings turn the frame and permute the nodes."""

    def __init__(self) -> None:
        rng = np.random.default_rng(5)
        self.shape = rng.normal(0, 0.5, (2, 12, 3))
        self.shape -= self.shape.mean(axis=1, keepdims=True)
        self.shape_gain = rng.normal(0, 0.1, (2, 24, 36))
        self.speed_gain = rng.normal(0, 0.15, (2, 24, 3))
        self.lean_gain = rng.normal(0, 0.05, (2, 36, 3))

    def step(self, kind: NDArray[np.int64], v: Array, nodes: Array, u: Array, rng: np.random.Generator) -> Any:
        """Next velocity [e, 3] and nodes [e, 12, 3], before any change of frame."""
        du, lean = u - OFFSET_M, (nodes - self.shape[kind]).reshape(len(v), -1)
        v = 0.6 * v + np.einsum("ei,eij->ej", lean, self.lean_gain[kind])
        v += np.einsum("ei,eij->ej", du, self.speed_gain[kind]) + rng.normal(0, 0.02, v.shape)
        push = np.einsum("ei,eij->ej", du, self.shape_gain[kind]) + rng.normal(0, 0.01, lean.shape)
        nodes = self.shape[kind] + (0.5 * lean + push).reshape(nodes.shape)
        return v, nodes - nodes.mean(axis=1, keepdims=True)

    def episodes(
        self, policy: PolicySnapshot, episodes: int, steps: int, seed: int, first_id: int = 0
    ) -> list[pa.Table]:
        """Episodes of `steps` steps with exploration noise of 0.1 m."""
        rng = np.random.default_rng(seed)
        kind = rng.integers(0, 2, episodes)
        face, entry = np.where(kind == 0, 3, 12), np.full(episodes, -1)
        v, nodes = np.zeros((episodes, 3)), self.shape[kind].copy()
        angle = rng.uniform(-np.pi, np.pi, episodes)
        log: list[dict[str, Array]] = []
        for _ in range(steps + 1):
            target = np.stack([np.cos(angle), np.sin(angle)], axis=1)
            observation = np.zeros((episodes, schema.OBSERVATION_N), dtype=np.float32)
            observation[:, 0], observation[:, 43:45], observation[:, 45:47] = kind, target, v[:, :2]
            mean = act(policy, observation[:, : policy.layers[0][0].shape[1]])
            u = np.clip(mean + rng.normal(0, 0.1, mean.shape), 0.65, 1.35).astype(np.float32)
            draw = rng.random(episodes)
            exit_ = np.where(draw < 0.12, rng.integers(0, 3, episodes), -1)
            jump = draw > 0.995
            columns = {"face": face, "kind": kind, "entry_edge": entry, "exit_edge": exit_}
            columns |= {"com_velocity": v, "nodes": nodes.reshape(episodes, 36), "target_direction": target}
            log.append(columns | {"observation": observation, "action": u, "action_mean": mean})
            v, nodes = self.step(kind, v, nodes, u, rng)
            moved = jump | (exit_ >= 0)
            turn = np.where(exit_ >= 0, (exit_ + 1) * 2.0, 0.0) + np.where(jump, rng.uniform(-3, 3, episodes), 0.0)
            angle += turn
            v, nodes = turned(v, turn), turned(nodes, turn)
            nodes[exit_ > 0] = nodes[exit_ > 0][:, ::-1]
            to_delta = (kind == 1) & (exit_ > 0)
            new_kind = np.where(to_delta, 0, 1)
            entry = np.where(moved, np.where(jump, -1, np.where(new_kind == 0, 0, np.where(kind == 0, 1, 0))), entry)
            kind = np.where(moved, new_kind, kind)
            shift = rng.integers(1, 8, episodes)
            face = np.where(moved, np.where(kind == 0, (face + shift) % 8, 8 + (face + shift - 8) % 12), face)
        return [self._table(log, episode, first_id + episode) for episode in range(episodes)]

    def _table(self, log: list[dict[str, Array]], episode: int, episode_id: int) -> pa.Table:
        rows = len(log)
        columns: dict[str, Any] = {name: [entry[name][episode] for entry in log] for name in log[0]}
        for name in ("entry_edge", "exit_edge"):
            columns[name] = [None if edge < 0 else int(edge) for edge in columns[name]]
        columns["exit_edge"][-1] = columns["action"][-1] = columns["action_mean"][-1] = None
        return frames_table(columns | {"episode_id": [episode_id] * rows, "step": range(rows)}, rows)


def act(policy: PolicySnapshot, observation: Array) -> Array:
    """Noise-free actions [e, nu] of a snapshot."""
    hidden = np.asarray(observation, dtype=np.float64)
    for number, (weight, bias) in enumerate(policy.layers):
        hidden = (hidden if number == 0 else np.tanh(hidden)) @ weight.T.astype(np.float64) + bias
    return policy.offset_m + policy.scale_m * hidden


def turned(vectors: Array, angle: Array) -> Array:
    """Vectors [e, ..., 3] turned about the vertical by angles [e]."""
    cosine, sine = np.cos(angle), np.sin(angle)
    turn = np.zeros((len(angle), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cosine, -sine, sine, cosine, 1
    return np.einsum("eij,e...j->e...i", turn, vectors)


@pytest.fixture(scope="session")
def world() -> HybridWorld:
    return HybridWorld()


@pytest.fixture(scope="session")
def untrained() -> PolicySnapshot:
    rng = np.random.default_rng(1)
    return initial(schema.OBSERVATION_N, 24, (16,), rng, offset_m=OFFSET_M, scale_m=SCALE_M)


@pytest.fixture(scope="session")
def tables(world: HybridWorld, untrained: PolicySnapshot) -> list[pa.Table]:
    """Twelve episodes of 80 steps with crossings, jumps and long stays."""
    return world.episodes(untrained, episodes=12, steps=80, seed=2)


def rows_and_segments(
    tables: Iterable[pa.Table], reduced_state: ReducedState = "nodes", longest_steps: int = 20
) -> tuple[Rows, Segments]:
    """Rows and segments of episodes as the learner makes them."""
    reading = Canonical(reduced_state)
    episodes = Episodes([reading], longest_steps)
    for table in tables:
        episodes.add(table.column("episode_id")[0].as_py(), table, {"noise_std_m": NOISE_STD_M})
    columns, pieces = episodes.joined()
    rows = reading.rows(columns)
    return rows, classify(rows, pieces)


@pytest.fixture(scope="session")
def read() -> Callable[..., tuple[Rows, Segments]]:
    return rows_and_segments


@pytest.fixture(scope="session")
def rows(tables: list[pa.Table]) -> Rows:
    return rows_and_segments(tables)[0]


@pytest.fixture(scope="session")
def segments(tables: list[pa.Table]) -> Segments:
    return rows_and_segments(tables)[1]


@pytest.fixture(scope="session")
def make_frames() -> Callable[..., pa.Table]:
    return frames_table


@pytest.fixture(scope="session")
def make_stays() -> Callable[..., pa.Table]:
    return stay_table


@pytest.fixture
def make_learner() -> Callable[..., Learner]:
    def make(fit_map: Any = map, run_seed: int = 3, keeps_earlier: bool = False, **settings: Any) -> Learner:
        small = {"hidden_layers": (16,), "epochs": 2, "smallest_class_segments": 10, "kl_weight": 0.02}
        task = Task(
            target_speed_m_per_s=0.8,
            vertical_weight=0.1,
            command_range_m=(0.65, 1.35),
            offset_m=OFFSET_M,
            scale_m=SCALE_M,
            reach_m=0.07,
            world_labels=np.tile(np.arange(24), (24, 1)),
            mirrored=np.arange(24) % 2 == 1,
        )
        return Learner(LearnerSettings(**small | settings), task, run_seed, fit_map, keeps_earlier)

    return make


@pytest.fixture(scope="session")
def iterate() -> Callable[..., None]:
    def run(
        learner: Learner, tables: list[pa.Table], noise_std_m: Callable[[pa.Table], float] = lambda _: NOISE_STD_M
    ) -> None:
        for table in tables:
            learner.add(table, noise_std_m(table))
        for phase in PHASES:
            assert all(0 <= done <= total for done, total in getattr(learner, phase.name)())

    return run

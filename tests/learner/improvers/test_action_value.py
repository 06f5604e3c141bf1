"""The action value: a planted world in which the best command is known, its slope, and going on from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch

from t6gps.learner import policy
from t6gps.learner.improvers import action_value as value
from t6gps.learner.learner import Learner
from t6gps.learner.settings import LearnerSettings, Localization
from t6gps.storage import schema
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import FRAMES

REACH_M, EPISODES_N, ROWS_N = 0.07, 100, 100
AHEAD, LEFT = 0, 1
"""Winches of the planted world: what the first two do in a step is its velocity along the axes of the frame."""


def planted(seed: int) -> value.Transitions:
    """Transitions in which 0.5 (e[0], e[1]) is the velocity after a step, in the frame before it, whatever came before.

    Frames are turned and mirrored at random from row to row.
    """
    rng = np.random.default_rng(seed)
    n = EPISODES_N * ROWS_N
    turn, heading = rng.uniform(-np.pi, np.pi, (2, n)).astype(np.float32)
    side = rng.choice([-1, 1], n).astype(np.float32)
    observation = rng.normal(0, 0.1, (n, schema.OBSERVATION_N)).astype(np.float32)
    angle = turn + side * heading
    observation[:, schema.TARGET] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    rest = rng.uniform(0.9, 1.3, (n, 24)).astype(np.float32)
    e = np.clip(rng.normal(0, 0.1, rest.shape).astype(np.float32) / np.float32(REACH_M), -1, 1)
    course = side * (np.arctan2(e[:, LEFT], e[:, AHEAD]) - turn)  # in the world
    after = turn[1:] + side[1:] * course[:-1]
    velocities = rng.normal(0, 0.1, (n, 39)).astype(np.float32)
    speed = 0.5 * np.hypot(e[:-1, LEFT], e[:-1, AHEAD])
    velocities[1:, :2] += (speed * np.array([np.cos(after), np.sin(after)])).T
    acts = np.arange(n) % ROWS_N != ROWS_N - 1
    return value.Transitions(np.hstack([observation, velocities, e]), rest, turn, side, heading, acts)


def untrained() -> PolicySnapshot:
    rng = np.random.default_rng(1)
    return policy.initial(schema.OBSERVATION_N, 24, (16,), rng, offset_m=1.088, scale_m=0.2)


def own_commands(transitions: value.Transitions) -> value.Floats:
    return policy.act(untrained(), transitions.inputs[:, : schema.OBSERVATION_N])


def learned(transitions: value.Transitions) -> value.ActionValue:
    found = value.ActionValue(REACH_M, 2.0, 0.1, np.random.default_rng(3))
    found.add(transitions)
    steps_n = found.steps_n
    assert sum(1 for _ in found.learn(untrained(), np.random.default_rng(4))) == steps_n
    return found


@pytest.fixture(scope="module")
def found() -> value.ActionValue:
    return learned(planted(0))


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def test_improved_actions_move_the_winches_that_drive_and_no_others(found: value.ActionValue) -> None:
    transitions = planted(0)
    own = own_commands(transitions)
    moved = found.improved(untrained()) - own
    within = np.abs(own - transitions.rest_lengths) < REACH_M / 2
    for winch, along in zip((AHEAD, LEFT), transitions.inputs[:, schema.TARGET].T, strict=True):
        clear = within & (np.abs(along) > 0.3)[:, None]
        signed = moved * np.sign(along)[:, None]
        assert (signed > 0)[clear[:, winch], winch].mean() > 0.95
        others = [signed[clear[:, other], other].mean() for other in range(2, 24)]
        assert np.abs(others).max() < 0.33 * signed[clear[:, winch], winch].mean()


def test_a_command_beyond_the_reach_of_its_winch_stays(found: value.ActionValue) -> None:
    transitions, own = planted(0), own_commands(planted(0))
    beyond = np.abs(own - transitions.rest_lengths) > REACH_M
    assert 0.3 < beyond.mean() < 0.9
    assert np.array_equal(found.improved(untrained())[beyond], own[beyond])


def test_the_slope_is_that_of_the_value(found: value.ActionValue) -> None:
    transitions, rows = planted(5), np.arange(50)
    rest = torch.from_numpy(transitions.rest_lengths[rows])
    command = rest + REACH_M * torch.linspace(-2, 2, 24).roll(3)
    inputs = torch.from_numpy(transitions.inputs[rows])

    def q(command: torch.Tensor) -> torch.Tensor:
        inputs[:, value.MOVED] = found._moved(transitions, rows, command)
        layers = [(weight.double(), bias.double()) for weight, bias in found._layers]
        return policy.activations(layers, inputs.double())[-1][:, 0]

    q(command)
    slope = found._slope(inputs)
    for winch in range(24):
        step = torch.zeros(24)
        step[winch] = 1e-3
        assert torch.allclose((q(command + step) - q(command - step)) / 2e-3, slope[:, winch].double(), atol=0.05)
        assert ((command - rest)[0, winch].abs() < REACH_M) == (slope[:, winch] != 0).any()


def test_the_last_row_of_an_episode_is_no_transition(found: value.ActionValue) -> None:
    """What stands in it besides its state is never read: poison it."""
    poisoned = planted(0)
    poisoned.inputs[~poisoned.acts, value.MOVED] = np.nan
    assert same(learned(poisoned).arrays(), found.arrays())


def test_learning_is_a_function_of_its_arguments_whatever_part_of_a_batch_is_done_first(
    found: value.ActionValue, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OneByOne:
        """Runs everything at once in this thread, the last part first."""

        def __init__(self, threads: int) -> None: ...
        def __enter__(self) -> OneByOne:
            return self

        def __exit__(self, *error: object) -> None: ...
        def map(self, function: Any, *items: Any) -> Iterator[Any]:
            return reversed([function(*each) for each in reversed(list(zip(*items, strict=True)))])

    expected = found.improved(untrained())
    monkeypatch.setattr(value, "ThreadPoolExecutor", OneByOne)
    other = learned(planted(0))
    assert same(other.arrays(), found.arrays())
    assert np.array_equal(other.improved(untrained()), expected)


def with_motion(table: pa.Table, seed: int) -> pa.Table:
    """The table with numbers in the columns that only the value reads."""
    rng = np.random.default_rng(seed)
    numbers = {
        "rest_lengths": list(rng.normal(1.0, 0.1, (table.num_rows, 24)).astype(np.float32)),
        "node_velocities": list(rng.normal(0.0, 0.3, (table.num_rows, 36)).astype(np.float32)),
        "element": rng.integers(0, 24, table.num_rows),
        "frame_yaw_rad": rng.uniform(-3, 3, table.num_rows),
    }
    for name, column in numbers.items():
        field = FRAMES.field(name)
        table = table.set_column(FRAMES.get_field_index(name), field, pa.array(column, type=field.type))
    return table


def test_what_is_read_of_an_episode_gives_back_its_columns(tables: list[pa.Table]) -> None:
    table, mirrored = with_motion(tables[0], 1), np.arange(24) % 2 == 1
    found = value.read({0: table}, mirrored, REACH_M)
    rows, target = np.arange(table.num_rows), schema.array(table, "target_direction")
    assert np.allclose(found.direction(rows, found.heading), target, atol=1e-5)
    moved = (schema.array(table, "action") - schema.array(table, "rest_lengths")[:-1]) / REACH_M
    assert np.allclose(found.inputs[:-1, value.MOVED], np.clip(moved, -1, 1), atol=1e-5)
    assert np.array_equal(found.inputs[:, value.COM_VELOCITY], schema.array(table, "com_velocity"))
    across = found.direction(rows, found.heading + np.float32(np.pi / 2))
    assert np.array_equal(found.towards(rows, across)[:, schema.TARGET].numpy(), across)
    sign = target[:, 0] * across[:, 1] - target[:, 1] * across[:, 0]  # a mirrored frame sees the other side
    assert np.allclose(sign, np.where(mirrored[schema.array(table, "element")], -1, 1), atol=1e-5)


def test_a_learner_goes_on_from_its_checkpoint_and_is_led_from_the_iteration_it_was_told(
    tables: list[pa.Table],
    make_learner: Callable[..., Learner],
    iterate: Callable[[Learner, list[pa.Table]], None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    for name in ("STEPS", "FIRST_STEPS"):
        monkeypatch.setattr(value, name, 30)
    monkeypatch.setattr(value, "REMEMBERED_N", 2)
    moving = [with_motion(table, number) for number, table in enumerate(tables)]
    kept: dict[int, list[pa.Table]] = {}
    monkeypatch.setattr(
        "t6gps.storage.tables.frames_of",
        lambda run, iteration, columns: {n: table.select(columns) for n, table in enumerate(kept[iteration])},
    )
    plain, led = make_learner(), make_learner(value_from=1)
    for iteration in range(4):
        resumed = make_learner(value_from=1)
        resumed.restore(*led.state())
        resumed.recall(None)  # type: ignore[arg-type]  # the tables above stand for those of a run
        for learner in (plain, led, resumed):
            iterate(learner, moving)
        kept[iteration] = moving
        assert same(led.state()[1], resumed.state()[1])
        differs = not np.array_equal(plain.snapshot.layers[0][0], led.snapshot.layers[0][0])
        assert differs == (iteration >= 1)


def test_the_value_knows_no_world_axes() -> None:
    with pytest.raises(ValueError, match="value_from must be 0 with localization = time"):
        LearnerSettings(value_from=1, localization=Localization.TIME)

"""The action value: a planted world in which the best command is known, its slope, and continuing from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch

from t6gps.learner import policy
from t6gps.learner.algorithm.features import Canonical
from t6gps.learner.episodes import Episodes
from t6gps.learner.improvers import action_value, transitions
from t6gps.learner.improvers.action_value import ActionValue
from t6gps.learner.improvers.transitions import MOVED, Filed, Held, Transitions, joined
from t6gps.learner.learner import Learner
from t6gps.learner.rows import Floats
from t6gps.learner.settings import ActionValueSettings, LearnerSettings, Localization
from t6gps.storage import schema
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, PolicySnapshot
from t6gps.storage.schema import FRAMES

REACH_M, EPISODES_N, ROWS_N, NOISE_STD_M = 0.07, 100, 100, 0.1
AHEAD, LEFT = 0, 1
"""Winches of the planted world: what the first two do in a step is its velocity along the axes of the frame."""


def planted(seed: int) -> Transitions:
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
    parts = observation, velocities[:, :3], velocities[:, 3:], rest + np.float32(REACH_M) * e
    return Transitions(Held(parts, rest), parts[1], turn, side, heading, acts, REACH_M)


def untrained() -> PolicySnapshot:
    rng = np.random.default_rng(1)
    return policy.initial(schema.OBSERVATION_N, 24, (16,), rng, offset_m=1.088, scale_m=0.2)


def every(known: Transitions) -> tuple[Floats, Floats]:
    """[s; e] and rest lengths of all rows."""
    inputs, rest_lengths = known.take(np.arange(len(known.acts)))
    return inputs.numpy(), rest_lengths.numpy()


def policys_commands(known: Transitions) -> Floats:
    return policy.act(untrained(), every(known)[0][:, : schema.OBSERVATION_N])


def learned(known: Transitions) -> ActionValue:
    value = ActionValue(ActionValueSettings(), 2.0, 0.1, np.random.default_rng(3))
    value.add(known)
    steps_n = value.steps_n
    assert sum(1 for _ in value.learn(untrained(), np.random.default_rng(4))) == steps_n
    return value


@pytest.fixture(scope="module")
def value() -> ActionValue:
    return learned(planted(0))


def same(a: dict[str, Any], b: dict[str, Any]) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def test_improved_actions_move_the_winches_that_drive_and_no_others(value: ActionValue) -> None:
    known = planted(0)
    commands, (inputs, rest_lengths) = policys_commands(known), every(known)
    moved = value.improved(untrained()) - commands
    within = np.abs(commands - rest_lengths) < REACH_M / 2
    for winch, along in zip((AHEAD, LEFT), inputs[:, schema.TARGET].T, strict=True):
        clear = within & (np.abs(along) > 0.3)[:, None]
        signed = moved * np.sign(along)[:, None]
        assert (signed > 0)[clear[:, winch], winch].mean() > 0.95
        others = [signed[clear[:, other], other].mean() for other in range(2, 24)]
        assert np.abs(others).max() < 0.33 * signed[clear[:, winch], winch].mean()


def test_a_command_beyond_the_reach_of_its_winch_stays(value: ActionValue) -> None:
    commands, (_, rest_lengths) = policys_commands(planted(0)), every(planted(0))
    beyond = np.abs(commands - rest_lengths) > REACH_M
    assert 0.3 < beyond.mean() < 0.9
    assert np.array_equal(value.improved(untrained())[beyond], commands[beyond])


def test_the_slope_is_that_of_the_value(value: ActionValue) -> None:
    inputs, rest = planted(5).take(np.arange(50))
    command = rest + REACH_M * torch.linspace(-2, 2, 24).roll(3)

    def at(command: torch.Tensor) -> torch.Tensor:
        moved = inputs.clone()
        moved[:, MOVED] = ((command - rest) / REACH_M).clamp(-1, 1)
        return moved

    slope, step_m = value.slope(at(command), REACH_M), 2e-2
    for winch in range(24):
        step = torch.zeros(24)
        step[winch] = step_m
        within = (command - rest)[0, winch].abs()
        if (within - REACH_M).abs() > step_m:
            difference = (value.values(at(command + step)) - value.values(at(command - step))) / (2 * step_m)
            assert torch.allclose(difference, slope[:, winch], atol=0.05)
        assert (within < REACH_M) == (slope[:, winch] != 0).any()


def test_the_slope_in_the_state_is_that_of_the_value_with_the_command_held(value: ActionValue) -> None:
    """x = [velocity; nodes; rest lengths]; rest lengths move e as well."""
    rows = np.arange(50)
    inputs, rest = planted(0).take(rows)
    command = torch.from_numpy(policy.act(untrained(), inputs[:, : schema.OBSERVATION_N].numpy()))

    def at(change: torch.Tensor) -> torch.Tensor:
        velocity, nodes, rests = change.split([3, 36, 24])
        moved = inputs.clone()
        moved[:, schema.OBSERVATION_N : schema.OBSERVATION_N + 3] += velocity
        moved[:, schema.NODES] += nodes / schema.NODE_SCALE_M
        moved[:, schema.REST_LENGTHS] += rests / schema.REST_LENGTH_SCALE_M
        moved[:, MOVED] = ((command - rest - rests) / REACH_M).clamp(-1, 1)
        return value.values(moved)

    slope, step = torch.from_numpy(value.state_slopes(untrained())[rows]), 3e-3
    for entry in range(63):
        change = torch.zeros(63)
        change[entry] = step
        difference = (at(change) - at(-change)) / (2 * step)
        smooth = torch.ones(50, dtype=torch.bool)
        if entry >= 39:
            winch = entry - 39
            smooth = ((command - rest)[:, winch].abs() - REACH_M).abs() > step
        assert torch.allclose(difference[smooth], slope[smooth, entry], rtol=0.02, atol=0.02)
    assert slope.abs().max() > 0.1


def test_the_last_row_of_an_episode_is_no_transition(value: ActionValue) -> None:
    """What stands in it besides its state is never read: spoil it."""
    spoiled = planted(0)
    assert isinstance(spoiled.wide, Held)
    spoiled.wide.parts[-1][~spoiled.acts] = np.nan
    assert same(learned(spoiled).arrays(), value.arrays())


def test_learning_is_a_function_of_its_arguments_whatever_part_of_a_batch_is_done_first(
    value: ActionValue, monkeypatch: pytest.MonkeyPatch
) -> None:
    class OneByOne:
        """Runs everything at once in this thread, the last part first."""

        def __init__(self, threads: int) -> None: ...
        def __enter__(self) -> OneByOne:
            return self

        def __exit__(self, *error: object) -> None: ...
        def map(self, function: Any, *items: Any) -> Iterator[Any]:
            return reversed([function(*each) for each in reversed(list(zip(*items, strict=True)))])

    expected = value.improved(untrained())
    monkeypatch.setattr(action_value, "ThreadPoolExecutor", OneByOne)
    other = learned(planted(0))
    assert same(other.arrays(), value.arrays())
    assert np.array_equal(other.improved(untrained()), expected)


@pytest.mark.slow
def test_transitions_that_are_filed_away_are_learned_from_as_those_in_memory(value: ActionValue) -> None:
    known = planted(0)
    assert isinstance(known.wide, Held) and known.filed() is known, "an iteration of this size stays in memory"
    filed = known.filed(held_rows=0)
    assert isinstance(filed.wide, Filed) and filed.filed(held_rows=0) is filed
    assert same(learned(filed).arrays(), value.arrays())


def test_transitions_of_several_iterations_are_taken_as_from_one() -> None:
    parts = [planted(seed) for seed in range(3)]
    several = joined([parts[0], parts[1].filed(held_rows=0), parts[2]])
    n = len(parts[0].acts)
    rows = np.random.default_rng(0).integers(3 * n, size=200)
    for taken, wholes in zip(several.take(rows), zip(*map(every, parts), strict=True), strict=True):
        assert np.array_equal(taken.numpy(), np.concatenate(wholes)[rows])
    headings = np.concatenate([part.heading for part in parts])[rows]
    assert np.array_equal(several.heading[rows], headings)
    single = parts[1].direction(rows[(rows >= n) & (rows < 2 * n)] - n, headings[(rows >= n) & (rows < 2 * n)])
    assert np.array_equal(several.direction(rows, headings)[(rows >= n) & (rows < 2 * n)], single)


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "missing"))
    with pytest.raises(RunError, match=r"10000 transitions cannot be filed away in .*missing.*TMPDIR"):
        planted(0).filed(held_rows=0)


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
    taken = Episodes([Canonical("nodes"), transitions.Motion(mirrored)], longest_segment_steps=20)
    taken.add(0, table.select(transitions.COLUMNS))
    known = transitions.of_columns(taken.joined().columns, REACH_M)
    rows, target = np.arange(table.num_rows), schema.array(table, "target_direction")
    assert np.allclose(known.direction(rows, known.heading), target, atol=1e-5)
    inputs, _ = every(known)
    moved = (schema.array(table, "action") - schema.array(table, "rest_lengths")[:-1]) / REACH_M
    assert np.allclose(inputs[:-1, MOVED], np.clip(moved, -1, 1), atol=1e-5) and not inputs[-1, MOVED].any()
    assert np.array_equal(known.com_velocity, schema.array(table, "com_velocity"))
    state = np.hstack([schema.array(table, name) for name in transitions.STATE])
    assert np.array_equal(inputs[:, : state.shape[1]], state)
    across = known.direction(rows, known.heading + np.float32(np.pi / 2))
    assert np.array_equal(known.take(rows, across)[0][:, schema.TARGET].numpy(), across)
    sign = target[:, 0] * across[:, 1] - target[:, 1] * across[:, 0]  # a mirrored frame sees the other side
    assert np.allclose(sign, np.where(mirrored[schema.array(table, "element")], -1, 1), atol=1e-5)


def recorded(table: pa.Table, columns: Sequence[str]) -> Episode:
    """An episode of which some columns are read."""
    return Episode(table.select([*columns, "episode_id"]), pa.table({"noise_std_m": [NOISE_STD_M]}))


def test_a_learner_goes_on_from_its_checkpoint_and_is_led_from_the_iteration_it_was_told(
    tables: list[pa.Table],
    make_learner: Callable[..., Learner],
    iterate: Callable[[Learner, list[pa.Table]], None],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    few = ActionValueSettings(steps=30, first_steps=30, remembered_iterations=3, improved_iterations=2, critics=2)
    led_by = {"value_from": 1, "action_value": few, "rounds": 2, "models_share": 0.5, "replay_iterations": 0}
    moving = [with_motion(table, number) for number, table in enumerate(tables)]
    kept: dict[int, list[pa.Table]] = {}
    monkeypatch.setattr(
        "t6gps.storage.tables.episodes_of",
        lambda run, iteration, columns: [recorded(table, columns) for table in kept[iteration]],
    )
    plain, led = make_learner(), make_learner(**led_by)
    for iteration in range(4):
        resumed = make_learner(**led_by)
        resumed.restore(*led.state())
        resumed.recall(None)  # type: ignore[arg-type]  # the tables above stand for those of a run
        for learner in (plain, led, resumed):
            iterate(learner, moving)
        kept[iteration] = moving
        assert same(led.state()[1], resumed.state()[1])
        differs = not np.array_equal(plain.snapshot.layers[0][0], led.snapshot.layers[0][0])
        assert differs == (iteration >= 1)


def test_what_leads_with_the_value_matters(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Callable[[Learner, list[pa.Table]], None]
) -> None:
    few = ActionValueSettings(steps=30, first_steps=30)
    led_by = {"value_from": 1, "action_value": few, "models_share": 0.5, "models_horizon_steps": 2, "rounds": 1}
    changes = [{}, {"models_share": 0.0}, {"models_horizon_steps": 1}, {"rounds": 2}]
    made = set()
    for change in changes:
        learner = make_learner(**led_by | change)
        for _ in range(2):
            iterate(learner, [with_motion(table, number) for number, table in enumerate(tables)])
        made.add(learner.snapshot.layers[0][0].tobytes())
    assert len(made) == len(changes)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"rounds": 2}, "need an action value; set value_from"),
        ({"models_share": 0.5}, "need an action value; set value_from"),
        ({"models_share": 0.5, "value_from": 1, "reduced_state": "com"}, "models_share needs reduced_state = nodes"),
        ({"action_value": {"improved_iterations": 4}}, "is more than remembered_iterations = 3; remember as many"),
        ({"action_value": {"improved_iterations": 2}, "value_from": 1}, "would add their old ones; set it to 0"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        LearnerSettings(**wrong)


SMALL = {"hidden_layers": (8,), "batch": 16, "steps": 3, "first_steps": 5}
CHANGES = {
    "remembered_iterations": 1, "discount": 0.5, "hidden_layers": (9,), "batch": 17, "steps": 4, "first_steps": 6,
    "learning_rate": 2e-3, "weight_decay": 0.5, "target_rate": 0.5, "own_heading_share": 1.0, "step_weight": 0.1,
    "ascents": 2, "ascent_rate": 0.25, "critics": 2, "improved_iterations": 2,
}  # fmt: skip


def climbed(settings: ActionValueSettings) -> bytes:
    """Actions that two iterations of learning lead to."""
    value = ActionValue(settings, 2.0, 0.1, np.random.default_rng(3))
    for seed in range(2):
        value.add(planted(seed))
        assert sum(1 for _ in value.learn(untrained(), np.random.default_rng(seed))) == (
            settings.steps if seed else settings.first_steps
        )
    return value.improved(untrained()).tobytes()


def test_every_setting_of_the_action_value_matters() -> None:
    elsewhere = {"reach_noise"}  # test_seeding
    assert {*CHANGES, *elsewhere} == set(ActionValueSettings.model_fields)
    changed = [climbed(ActionValueSettings(**SMALL | {name: value})) for name, value in CHANGES.items()]
    assert len({climbed(ActionValueSettings(**SMALL)), *changed}) == 1 + len(CHANGES)


def test_gradient_steps_need_not_fill_what_is_prepared_at_once() -> None:
    value = ActionValue(
        ActionValueSettings(hidden_layers=(4,), batch=4, first_steps=37), 2.0, 0.1, np.random.default_rng(3)
    )
    value.add(planted(0))
    assert sum(1 for _ in value.learn(untrained(), np.random.default_rng(0))) == 37


def test_the_value_knows_no_world_axes() -> None:
    with pytest.raises(ValueError, match="value_from must be 0 with localization = time"):
        LearnerSettings(value_from=1, localization=Localization.TIME)

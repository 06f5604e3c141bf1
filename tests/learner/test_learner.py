"""Laws of one iteration: order, determinism, restoring, and improvement."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner import policy
from t6gps.learner.cost import running_cost
from t6gps.learner.learner import Learner
from t6gps.learner.rows import Rows
from t6gps.learner.settings import LearnerSettings, Localization, ModeSearch
from t6gps.storage import fields, schema
from t6gps.storage.errors import CheckpointError, DataError, RunError
from t6gps.storage.records import PolicySnapshot

Iterate = Callable[[Learner, list[pa.Table]], None]


def weights(snapshot: PolicySnapshot) -> bytes:
    return b"".join(part.tobytes() for layer in snapshot.layers for part in layer)


def test_the_order_of_arrival_and_of_fitting_does_not_matter(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    def backwards(function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
        return iter([function(item) for item in reversed(list(items))][::-1])

    forward, backward = make_learner(), make_learner(fit_map=backwards)
    iterate(forward, tables)
    iterate(backward, tables[::-1])
    assert weights(forward.snapshot) == weights(backward.snapshot)
    assert forward.report() == backward.report()


def test_a_restored_learner_goes_on_with_identical_bytes(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    whole = make_learner()
    iterate(whole, tables[:8])
    manifest, arrays = whole.state()
    manifest, arrays = dict(manifest), {name: array.copy() for name, array in arrays.items()}
    restored = make_learner()
    restored.restore(manifest, arrays)
    for learner in (whole, restored):
        iterate(learner, tables[4:])
    assert whole.snapshot.version == restored.snapshot.version == 2
    assert weights(whole.snapshot) == weights(restored.snapshot)
    assert whole.report() == restored.report()


def test_the_policy_before_the_newest_is_kept_where_it_is_asked_for_and_in_checkpoints(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner, forgetful = make_learner(keeps_earlier=True), make_learner()
    untrained = learner.policy(0)
    for each in (learner, forgetful):
        iterate(each, tables[:8])
    assert learner.policy() is learner.policy(1) and learner.policy(0) is untrained
    assert weights(learner.policy()) == weights(forgetful.policy())
    restored = make_learner(keeps_earlier=True)
    restored.restore(*learner.state())
    assert restored.policy(0).version == 0 and weights(restored.policy(0)) == weights(untrained)
    with pytest.raises(RunError, match="version 0 is not kept"):
        forgetful.policy(0)
    with pytest.raises(CheckpointError, match="earlier_layer_0_weight"):
        restored.restore(*forgetful.state())


def test_a_checkpoint_that_does_not_fit_is_refused(make_learner: Callable[..., Learner]) -> None:
    manifest, arrays = make_learner().state()
    with pytest.raises(CheckpointError, match="hidden_layers"):
        make_learner(hidden_layers=(17,)).restore(manifest, arrays)
    with pytest.raises(CheckpointError, match="layer_0_bias"):
        make_learner().restore(manifest, {name: a for name, a in arrays.items() if name != "layer_0_bias"})


def test_phases_out_of_order_and_repeated_episodes_are_refused(
    tables: list[pa.Table], make_learner: Callable[..., Learner]
) -> None:
    learner = make_learner()
    with pytest.raises(DataError, match="no episodes"):
        list(learner.segment())
    with pytest.raises(RunError, match="segment"):
        list(learner.fit())
    learner.add(tables[0], 0.1)
    with pytest.raises(DataError, match="twice"):
        learner.add(tables[0], 0.1)
    with pytest.raises(RunError, match=r"supervise\(\) must come first"):
        learner.report()


def test_the_report_fills_the_columns_of_its_tables(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner = make_learner()
    iterate(learner, tables)
    iteration, classes, models = learner.report()
    assert set(iteration) <= set(schema.ITERATIONS.names)
    table = fields.check(pa.Table.from_pylist(classes, schema=schema.CLASSES), schema.CLASSES, "classes")
    actions = sum(table.num_rows - 1 for table in tables)
    assert sum(table.column("rows").to_pylist()) == actions
    assert sum(table.column("segments").to_pylist()) == iteration["segments"]
    assert iteration["classes"] == table.column("pooled").to_pylist().count(False)
    assert iteration["predicted_cost_change"] < 0 < iteration["action_change_m"]
    fields.check(models, schema.MODELS, "models")


def test_the_models_of_the_report_explain_the_samples_that_they_say(
    tables: list[pa.Table], rows: Rows, make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner = make_learner()
    iterate(learner, tables)
    iteration, _, models = learner.report()
    found = models.to_pylist()
    assert sum(model["samples"] for model in found) == rows.continues.sum()
    weighted = sum(model["samples"] * model["residual"] for model in found if model["samples"])
    assert weighted / rows.continues.sum() == pytest.approx(iteration["residual"])
    places = [(model["bin"], model["step"], model["mode"]) for model in found]
    assert sorted(set(places)) == places
    nx, nu = rows.state.shape[1], rows.action.shape[1]
    sizes = [len(model["dynamics_matrix"]) for model in found] + [len(model["policy_matrix"]) for model in found]
    assert set(sizes) == {nx * (nx + nu), nu * nx}
    assert all((np.array(model["action_variance"]) >= 0).all() for model in found)


def test_the_report_of_an_iteration_is_the_mean_of_its_classes_over_their_rows(
    tables: list[pa.Table], rows: Rows, make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner, episodes = make_learner(), rows
    iterate(learner, tables)
    iteration, classes, _ = learner.report()
    change = policy.act(learner.snapshot, episodes.observation).clip(0.65, 1.35) - episodes.action_mean
    variance = np.nanmean((episodes.action - episodes.action_mean) ** 2)
    assert iteration["policy_kl"] == pytest.approx(np.nanmean((change**2).sum(axis=1)) / 2 / variance, rel=1e-4)
    weights = [row["rows"] for row in classes]
    assert np.average([row["policy_kl"] for row in classes], weights=weights) == pytest.approx(iteration["policy_kl"])
    # Jumps are no samples of the dynamics: a class's rows outnumber its predicted changes by them.
    predicted = np.average([row["predicted_cost_change"] for row in classes], weights=weights)
    assert predicted == pytest.approx(iteration["predicted_cost_change"], rel=0.05)
    after = running_cost(episodes.state, episodes.target, 0.8, 0.1)[1:][episodes.acts[:-1]]
    assert np.average([row["cost"] for row in classes], weights=weights) == pytest.approx(after.mean(), rel=1e-5)
    assert 0 < iteration["supervised_loss"] < iteration["supervised_loss_before"]
    assert iteration["saturated_share"] == 0.0


def with_column(table: pa.Table, name: str, values: np.ndarray) -> pa.Table:
    column = pa.array([*values, *[None] * (len(table) - len(values))], type=schema.FRAMES.field(name).type)
    return table.set_column(schema.FRAMES.get_field_index(name), schema.FRAMES.field(name), column)


def test_commands_at_an_end_of_the_range_count_as_saturated(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner, planted = make_learner(), []
    for table in tables:
        mean = schema.array(table, "action_mean").copy()
        mean[:, :6], mean[:, 6:9] = np.float32(0.65), np.float32(1.35)
        planted.append(with_column(table, "action_mean", mean))
    iterate(learner, planted)
    assert learner.report()[0]["saturated_share"] == pytest.approx(9 / 24)


@pytest.mark.parametrize("deviation_from", ["recorded", "fitted"])
def test_a_policy_without_noise_and_winches_at_their_limit_are_learned_from(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate, deviation_from: str
) -> None:
    """No exploration and constant commands: S has its floor and the slopes of these cables vanish."""
    learner, planted = make_learner(deviation_from=deviation_from), []
    for table in tables:
        constant = np.full_like(schema.array(table, "action"), 1.35)
        planted.append(with_column(with_column(table, "action", constant), "action_mean", constant))
    iterate(learner, planted)
    iteration, classes, _ = learner.report()
    assert all(np.isfinite(value) for row in [iteration, *classes] for value in row.values() if value is not None)
    assert iteration["saturated_share"] == 1.0
    assert iteration["action_change_m"] < 1e-3, "actions that were never varied have no known effect"


def test_a_class_with_one_sample_is_learned_from(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner = make_learner(smallest_class_segments=1)
    iterate(learner, tables[:2])
    iteration, classes, _ = learner.report()
    assert min(row["rows"] for row in classes) == 1
    assert np.isfinite(learner.state()[1]["replay_0_actions"]).all()
    assert iteration["predicted_cost_change"] < 0


BASE = {
    "reduced_state": "com", "longest_segment_steps": 3, "smallest_class_segments": 1000, "residual_threshold": 0.15,
}  # fmt: skip
CHANGES = {
    "reduced_state": "nodes", "localization": Localization.KIND,
    "mode_search": ModeSearch.GAUSSIAN, "longest_segment_steps": 5, "smallest_class_segments": 10, "modes": 1,
    "residual_threshold": 0.3, "prior_samples": 5.0, "ridge": 0.1, "horizon_steps": 3, "kl_weight": 0.2,
    "deviation_from": "fitted", "observation": "sensors", "hidden_layers": (8,), "epochs": 1, "batch": 50,
    "learning_rate": 1e-2,
}  # fmt: skip


def test_every_setting_matters(tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate) -> None:
    led_by_value = {"value_from", "action_value", "rounds", "models_share", "models_horizon_steps"}
    elsewhere = {"replay_iterations", *led_by_value}  # below, and in test_action_value
    assert {*CHANGES, *elsewhere} == set(LearnerSettings.model_fields)
    results = []
    for change in [{}, *({name: value} for name, value in CHANGES.items())]:
        learner = make_learner(**BASE | change)
        iterate(learner, tables)
        results.append(weights(learner.snapshot))
    assert len(set(results)) == len(results)


def test_the_cost_counts_states_after_a_step_towards_their_own_targets(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    """The target of an episode's first row leads nowhere; that of the last row is aimed at."""
    improved = {}
    for row in (None, 0, -1):
        learner = make_learner()
        turned = []
        for table in tables:
            target = schema.array(table, "target_direction").copy()
            if row is not None:
                target[row] *= -1
            turned.append(with_column(table, "target_direction", target))
        iterate(learner, turned)
        improved[row] = learner.state()[1]["replay_0_actions"].tobytes()
    assert improved[0] == improved[None] != improved[-1]


def test_replayed_pairs_matter_from_the_second_iteration_on(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learners = [make_learner(replay_iterations=n) for n in (0, 1)]
    after = []
    for batch in (tables[:6], tables[6:]):
        for learner in learners:
            iterate(learner, batch)
        after.append(weights(learners[0].snapshot) == weights(learners[1].snapshot))
    assert after == [True, False]


def test_improved_actions_stay_in_the_command_range(
    tables: list[pa.Table], make_learner: Callable[..., Learner], iterate: Iterate
) -> None:
    learner = make_learner(kl_weight=1e-3)
    iterate(learner, tables)
    actions = learner.state()[1]["replay_0_actions"]
    assert np.float32(0.65) <= actions.min() and actions.max() <= np.float32(1.35)
    assert np.isfinite(actions).all()


def test_hidden_layers_may_come_as_a_list() -> None:
    assert LearnerSettings(hidden_layers=[64, 64]).hidden_layers == (64, 64)  # type: ignore[arg-type]


@pytest.mark.parametrize("deviation_from", ["recorded", "fitted"])
def test_iterations_turn_noise_into_motion_towards_the_target(
    world: Any, make_learner: Callable[..., Learner], iterate: Iterate, deviation_from: str
) -> None:
    learner = make_learner(hidden_layers=(64,), epochs=8, batch=128, deviation_from=deviation_from)
    speeds = []
    for iteration in range(3):
        tables = world.episodes(learner.snapshot, 20, 80, seed=iteration)
        speeds.append(
            np.mean([np.sum(schema.array(t, "com_velocity")[:, :2] * schema.array(t, "target_direction"), axis=1)
                     for t in tables])
        )  # fmt: skip
        iterate(learner, tables)
    assert abs(speeds[0]) < 0.05 and speeds[1] > 0.15 and speeds[2] > speeds[1] + 0.1

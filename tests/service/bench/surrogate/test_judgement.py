"""An iteration of a run is judged by what the simulator makes of it, whichever improver led it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import tiny_run
from command import t6gps

from t6gps.service.bench.surrogate import branches, gradients
from t6gps.service.bench.surrogate.stored import Stored, load, promised_mean
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import DataError

pytestmark = pytest.mark.slow
SETTINGS = (
    *tiny_run.settings(),
    "--set=learner.value_from=1",
    "--set=learner.action_value.first_steps=20",
    "--set=learner.action_value.steps=10",
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a run whose first iteration the backward pass led, and the other two an action value."""
    root = tmp_path_factory.mktemp("judged")
    t6gps("train", "flat-quick", "--run", "tiny", "--serial", "--root", root, *SETTINGS)
    return root


@pytest.fixture(scope="module")
def run(root: Path) -> Run:
    return catalog.open_run(root, "tiny")


@pytest.fixture(scope="module")
def first(run: Run) -> Stored:
    return load(run, 0, lambda _: None)


@pytest.mark.parametrize("iteration", [0, 2])
def test_an_iteration_learned_from_again_promises_what_it_had_promised(run: Run, iteration: int) -> None:
    said: list[str] = []
    stored = load(run, iteration, said.append)
    assert stored.led_by_value == (iteration > 0)
    row = tables.read(run, "iterations").to_pylist()[iteration]
    assert promised_mean(stored) == row["predicted_cost_change"]
    assert not [line for line in said if "promised" in line]
    F = stored.redone.surrogate.series.models.F.astype(np.float32)
    models = tables.read(run, "models").to_pylist()
    matrices = [row["dynamics_matrix"] for row in models if row["iteration"] == iteration]
    assert np.array_equal(F.reshape(len(F), -1), np.array(matrices, dtype=np.float32))


def test_other_settings_of_the_learner_are_judged_on_the_same_episodes(run: Run, first: Stored) -> None:
    other = load(run, 0, lambda _: None, ["learner.reduced_state=nodes+cables"])
    assert other.redone.rows.state.shape[1] == first.redone.rows.state.shape[1] + 24
    assert np.array_equal(other.redone.rows.observation, first.redone.rows.observation)
    steps = branches.sampled(first, 4, np.random.default_rng(0))
    ours, others = (branches.wanted_changes(stored, steps) for stored in (first, other))
    assert np.array_equal(ours["network"], others["network"]) and not np.array_equal(ours["pass"], others["pass"])


def test_pieces_without_a_change_cost_what_is_recorded(first: Stored) -> None:
    steps = branches.sampled(first, 4, np.random.default_rng(0))
    still = branches.branched(first, steps, {"none": np.zeros((*steps.shape, 24), dtype=np.float32)})["none"]
    recorded = np.concatenate([episode.frames.column("cost").to_numpy() for episode in first.episodes])
    assert np.abs(still.cost - recorded[steps + 1]).max() < 1e-3
    velocity = first.redone.rows.state[steps[:, 0] + 1, :3]
    assert still.after[:, :3] == pytest.approx(velocity, abs=1e-4)


def test_what_the_network_took_up_is_new_minus_old(first: Stored) -> None:
    steps = branches.sampled(first, 4, np.random.default_rng(0))
    taken_up = branches.wanted_changes(first, steps)["network"]
    old = first.commands(first.acting, steps.ravel()).reshape(taken_up.shape)
    assert old == pytest.approx(first.redone.rows.action_mean[steps], abs=1e-6)
    new = first.commands(first.newest, steps.ravel()).reshape(taken_up.shape)
    assert taken_up == pytest.approx(new - old, abs=1e-6)


def test_tried_actions_lie_within_the_reach_on_either_side(first: Stored) -> None:
    tried = gradients.moved(first, 20, np.random.default_rng(0))
    low, high = first.command_range_m
    for moved in (tried.own, tried.plus, tried.minus):
        assert np.abs(moved).max() <= 1 + 1e-5
    for moved in (tried.plus, tried.minus):
        command = tried.rest + first.reach_m * moved
        assert low - 1e-6 <= command.min() and command.max() <= high + 1e-6
    assert (np.abs(tried.plus - tried.minus).max(axis=1) > 0.5).all()


def test_the_same_first_action_makes_no_difference(first: Stored) -> None:
    tried = gradients.moved(first, 3, np.random.default_rng(0))
    same = gradients.realised(first, gradients.Moved(tried.rows, tried.rest, tried.own, tried.own, tried.own))
    assert np.array_equal(same, np.zeros_like(same))
    other = gradients.realised(first, tried)
    assert (np.abs(other).sum(axis=1) > 0).all()


def test_the_command_judges_the_last_iteration_of_the_backward_pass(root: Path) -> None:
    command = ("bench", "surrogate", "tiny", "--pieces=3", "--states=4", "--json", "--root", root)
    measured = json.loads(t6gps(*command, "--seed=5").stdout)
    figures = measured["results"]
    assert figures["iteration"] == 0 and figures["seed"] == 5 and figures["led_by_action_value"] == 0
    assert figures["pieces"] == 3 and figures["gradient_states"] == 4
    assert figures["replay_largest_cost_difference"] < 1e-3
    for name in ("pass", "value", "network"):
        assert figures[f"branch_{name}_ratio"] == pytest.approx(
            figures[f"branch_{name}_realised"] / figures[f"branch_{name}_promised"]
        )
    for name in ("pass", "value", "mean"):
        assert figures[f"gradient_{name}_5_steps_n"] == 4
    assert {"held_out_com_velocity_r2", "response_nodes_slope", "branch_pass_quarter_realised"} <= figures.keys()
    assert json.loads(t6gps(*command, "--seed=5").stdout)["results"] == figures


def test_a_run_that_goes_otherwise_here_is_not_judged(first: Stored) -> None:
    shifted = [replace(episode, frames=_elsewhere(episode.frames)) for episode in first.episodes]
    with pytest.raises(DataError, match="0 of 3 pieces of iteration 0 go here as recorded"):
        branches.branch_test(replace(first, episodes=shifted), 3, {"": 1.0}, np.random.default_rng(0))


def _elsewhere(frames: pa.Table) -> pa.Table:
    """Frames of a robot that moves otherwise."""
    name = "bar_velocities"
    faster = pa.array([[2 * speed for speed in row] for row in frames.column(name).to_pylist()], pa.list_(pa.float32()))
    return frames.set_column(frames.schema.get_field_index(name), frames.schema.field(name), faster)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["surrogate"], ["needs a run", "t6gps bench surrogate RUN"]),
        (["surrogate", "tinny"], ["no run 'tinny'", "did you mean 'tiny'"]),
        (["surrogate", "tiny", "--iteration=7"], ["no iteration 7", "0 to 2", "--iteration"]),
        (["surrogate", "tiny", "--rounds=2"], ["no --rounds", "pool, server"]),
        (["surrogate", "tiny", "--set=run.seed=1"], ["cannot change run.seed", "sampled already", "learner."]),
        (["surrogate", "tiny", "--set=learner.hidden_layers=[8]"], ["network of run tiny", "learner.hidden_layers"]),
        (["physics", "tiny"], ["bench physics measures no run"]),
        (["physics", "--pieces=3"], ["no --pieces", "surrogate"]),
    ],
)
def test_what_cannot_be_judged_is_refused(root: Path, arguments: list[str], words: list[str]) -> None:
    refused = t6gps("bench", *arguments, "--root", root, code=2)
    assert refused.stdout == b"" and refused.stderr.startswith("error: ")
    assert all(word in refused.stderr for word in words), refused.stderr

"""Laws of what is reported over episodes: what there is none of is None, never zero and never NaN."""

from __future__ import annotations

import json

import pyarrow as pa
import pytest

from t6gps.service.training.evaluation import EVALUATED, Estimate, Evaluation, Judged, summarise
from t6gps.service.training.loop import mean_and_error


def judged(**values: float | None) -> Judged:
    """The quantities of an episode; those that are not given are 1."""
    return {name: values.get(name, 1.0) for name in EVALUATED}


def test_mean_and_standard_error_are_those_of_the_episodes_that_have_a_quantity() -> None:
    assert mean_and_error(pa.chunked_array([[1.0, None], [3.0]])) == (2.0, pytest.approx(1.0))
    assert mean_and_error(pa.chunked_array([[1.0, None]])) == (1.0, None)
    assert mean_and_error(pa.chunked_array([pa.array([None], pa.float64())])) == (None, None)


def test_a_single_episode_has_no_standard_error() -> None:
    estimates = summarise([judged()], seed=0).estimates()
    assert list(estimates) == list(EVALUATED)
    assert set(estimates.values()) == {Estimate(1.0, None)}


def test_episodes_without_waypoints_or_a_second_have_no_such_mean() -> None:
    short = [judged(waypoints_per_episode=None, stuck_share_by_distance=None, slip_per_metre=None)] * 2
    evaluation = summarise(short, seed=0)
    assert evaluation.waypoints_per_episode == evaluation.stuck_share_by_distance == Estimate(None, None)
    assert evaluation.slip_per_metre == Estimate(None, None)
    assert evaluation.stuck_share_by_speed == Estimate(1.0, 0.0)
    stored = json.loads(evaluation.to_json(), parse_constant=lambda name: pytest.fail(f"{name} is no JSON"))
    assert stored["waypoints_per_episode"] == {"mean": None, "standard_error": None}
    assert Evaluation.from_json(evaluation.to_json()) == evaluation


def test_stuck_by_distance_comes_before_stuck_by_speed() -> None:
    keys = list(json.loads(summarise([judged()], seed=0).to_json()))
    assert keys.index("stuck_share_by_distance") < keys.index("stuck_share_by_speed")


def test_an_older_evaluation_is_read_with_its_share_by_speed() -> None:
    older = {"episodes": 2, "seed": 0, "stuck_share": {"mean": 0.25, "standard_error": 0.1}}
    evaluation = Evaluation.from_json(json.dumps(older))
    assert evaluation.stuck_share_by_speed == Estimate(0.25, 0.1)
    assert evaluation.stuck_share_by_distance == evaluation.cost_of_transport == Estimate()

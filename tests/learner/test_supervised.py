"""Laws of the policy network and the S-step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from t6gps.learner import policy, supervised
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.records import PolicySnapshot

SETTINGS = LearnerSettings(hidden_layers=(32, 32), epochs=30, batch=100, learning_rate=5e-3)


def first(seed: int = 0) -> PolicySnapshot:
    return policy.initial(7, 3, (32, 32), np.random.default_rng(seed), offset_m=1.088, scale_m=0.2)


def pairs(n: int = 1000) -> tuple[Any, Any]:
    """Actions of a planted linear policy that a small network can represent."""
    rng = np.random.default_rng(3)
    y = rng.normal(size=(n, 7)).astype(np.float32)
    return y, (1.088 + 0.2 * np.tanh(0.5 * y @ rng.normal(size=(7, 3)))).astype(np.float32)


def run(snapshot: PolicySnapshot, settings: LearnerSettings = SETTINGS, seed: int = 1) -> tuple[PolicySnapshot, float]:
    y, u = pairs()
    training = supervised.train(snapshot, y, u, settings, np.random.default_rng(seed))
    progress = []
    while True:
        try:
            progress.append(next(training))
        except StopIteration as end:
            assert progress == [(epoch + 1, settings.epochs) for epoch in range(settings.epochs)]
            return end.value


def same(a: PolicySnapshot, b: PolicySnapshot) -> bool:
    left, right = ([part.tobytes() for layer in s.layers for part in layer] for s in (a, b))
    return left == right


def test_the_untrained_policy_holds_the_neutral_shape() -> None:
    with torch.no_grad():
        output = policy.module(first())(torch.randn(100, 7))
    assert 0 < float(output.abs().max()) < 0.1
    assert first().version == 0


def test_the_untrained_policy_is_a_function_of_its_generator() -> None:
    assert same(first(0), first(0)) and not same(first(0), first(1))


def test_a_snapshot_survives_the_way_through_torch() -> None:
    snapshot = first()
    network = policy.module(snapshot)
    assert same(snapshot, policy.snapshot(network, version=0, offset_m=1.088, scale_m=0.2))


def test_training_does_not_touch_the_snapshot_it_starts_from() -> None:
    snapshot = first()
    trained, _ = run(snapshot)
    assert same(snapshot, first()) and not same(snapshot, trained)


def test_the_s_step_fits_a_planted_policy_and_reports_its_loss() -> None:
    trained, loss = run(first())
    y, u = pairs()
    with torch.no_grad():
        output = 1.088 + 0.2 * policy.module(trained)(torch.from_numpy(y)).numpy()
    assert np.abs(output - u).mean() < 0.02
    assert np.isclose(loss, np.mean(((output - u) / 0.2) ** 2), rtol=1e-3)
    assert trained.version == 1


def test_the_s_step_is_a_function_of_its_arguments() -> None:
    assert same(run(first())[0], run(first())[0])
    assert not same(run(first())[0], run(first(), seed=2)[0])


def test_a_warm_start_goes_on_where_it_stopped() -> None:
    once, loss = run(first())
    twice, lower = run(once)
    assert lower < loss and twice.version == 2

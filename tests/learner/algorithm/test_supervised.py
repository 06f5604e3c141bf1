"""Laws of the policy network and the S-step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from t6gps.learner import policy
from t6gps.learner.algorithm import supervised
from t6gps.learner.algorithm.pairs import every
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


def run(snapshot: PolicySnapshot, settings: LearnerSettings = SETTINGS, seed: int = 1) -> Any:
    y, u = pairs()
    training = supervised.train(snapshot, every(y, u), settings, np.random.default_rng(seed))
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
    observations = np.random.default_rng(0).standard_normal((100, 7)).astype(np.float32)
    departure_m = np.abs(policy.act(first(), observations) - 1.088)
    assert 0 < departure_m.max() < 0.1 * 0.2
    assert first().version == 0


def test_the_untrained_policy_is_a_function_of_its_generator() -> None:
    assert same(first(0), first(0)) and not same(first(0), first(1))


def network_of(snapshot: PolicySnapshot) -> torch.nn.Sequential:
    """The network as torch itself builds it."""
    parts: list[torch.nn.Module] = []
    for weight, bias in snapshot.layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        linear.load_state_dict({"weight": torch.tensor(weight), "bias": torch.tensor(bias)})
        parts += [linear, torch.nn.Tanh()]
    return torch.nn.Sequential(*parts[:-1])


def test_the_network_and_its_gradient_are_those_of_torch() -> None:
    snapshot, (y, u) = run(first())[0], pairs(300)
    inputs, targets = torch.from_numpy(y), torch.from_numpy(u)
    network, (vector, layers) = network_of(snapshot), policy.parameters(snapshot)
    torch.testing.assert_close(policy.activations(layers, inputs)[-1], network(inputs), rtol=1e-5, atol=1e-6)
    torch.nn.MSELoss()(network(inputs), targets).backward()
    expected = torch.cat([parameter.grad.reshape(-1) for parameter in network.parameters()])
    parts = [supervised.gradient(layers, inputs[part], targets[part], 300) for part in (slice(120), slice(120, 300))]
    assert parts[0].shape == vector.shape
    torch.testing.assert_close(parts[0] + parts[1], expected, rtol=1e-4, atol=1e-6)


def test_the_parameters_of_a_layer_are_a_view_of_the_vector() -> None:
    vector, layers = policy.parameters(first())
    vector.zero_()
    assert all(not part.any() for layer in layers for part in layer)
    assert first().layers[0][0].any()


def test_training_does_not_touch_the_snapshot_it_starts_from() -> None:
    snapshot = first()
    trained, _ = run(snapshot)
    assert same(snapshot, first()) and not same(snapshot, trained)


def test_the_s_step_fits_a_planted_policy_and_reports_its_loss() -> None:
    trained, loss = run(first())
    y, u = pairs()
    output = policy.act(trained, y)
    assert np.abs(output - u).mean() < 0.02
    assert np.isclose(loss.before, np.mean(((policy.act(first(), y) - u) / 0.2) ** 2), rtol=1e-3)
    assert np.isclose(loss.after, np.mean(((output - u) / 0.2) ** 2), rtol=1e-3)
    assert trained.version == 1


def test_the_s_step_is_a_function_of_its_arguments() -> None:
    assert same(run(first())[0], run(first())[0])
    assert not same(run(first())[0], run(first(), seed=2)[0])


def test_a_step_of_descent_is_that_of_torch() -> None:
    """With and without weight decay, over steps that differ in their rate."""
    rng = np.random.default_rng(0)
    for decay in (0.0, 0.01):
        ours = torch.from_numpy(rng.standard_normal(50).astype(np.float32))
        theirs, moments = ours.clone(), supervised.no_moments(ours)
        optimiser = torch.optim.AdamW([theirs], weight_decay=decay)
        for rate in (1e-3, 2e-2, 5e-4):
            change = torch.from_numpy(rng.standard_normal(50).astype(np.float32))
            theirs.grad, optimiser.param_groups[0]["lr"] = change.clone(), rate
            optimiser.step()
            supervised.descend(ours, change, moments, rate, decay)
        torch.testing.assert_close(ours, theirs)


def test_a_warm_start_goes_on_where_it_stopped() -> None:
    once, loss = run(first())
    twice, lower = run(once)
    assert np.isclose(lower.before, loss.after) and lower.after < loss.after and twice.version == 2

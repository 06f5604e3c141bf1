"""The compiled network is that of its definition, for any widths."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N, SENSORS_N
from t6gps.workers.episode import _policy, policy


def _snapshot(widths: list[int], scale: float) -> PolicySnapshot:
    rng = np.random.default_rng(0)
    layers = tuple(
        (
            (scale * rng.standard_normal((n_out, n_in)) / np.sqrt(n_in)).astype(np.float32),
            rng.standard_normal(n_out).astype(np.float32),
        )
        for n_in, n_out in pairwise(widths)
    )
    return PolicySnapshot(0, layers, 1.1, 0.2)


@pytest.mark.parametrize("widths", [[47, 256, 256, 256, 24], [47, 1, 24], [3, 33, 31, 64, 2], [47, 24]])
@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_commands_are_those_of_the_network(widths: list[int], scale: float) -> None:
    snapshot = _snapshot(widths, scale)
    act = policy.ready(snapshot)
    for observation in np.random.default_rng(1).standard_normal((20, widths[0])).astype(np.float32):
        hidden = observation.astype(np.float64)
        for weight, bias in snapshot.layers[:-1]:
            hidden = np.tanh(weight @ hidden + bias)
        weight, bias = snapshot.layers[-1]
        size = scale * np.sqrt(max(widths))  # sums of this many products are rounded to 6e-8 of their size
        assert np.abs(act(observation) - (1.1 + 0.2 * (weight @ hidden + bias))).max() < 1e-5 * max(size, 0.1)


def test_a_policy_sees_as_many_entries_as_its_first_layer_takes() -> None:
    act = policy.ready(_snapshot([SENSORS_N, 32, 24], 1.0))
    observation = np.random.default_rng(1).standard_normal(OBSERVATION_N).astype(np.float32)
    assert np.array_equal(act(observation), act(observation[:SENSORS_N]))


def test_what_does_not_fit_is_refused() -> None:
    act = policy.ready(_snapshot([47, 32, 24], 1.0))
    with pytest.raises(ValueError, match="other types or sizes"):
        act(np.zeros(46, dtype=np.float32))
    with pytest.raises(ValueError, match="other types or sizes"):
        act(np.zeros(47))  # type: ignore[arg-type]
    widths = np.array([47, 5000], dtype=np.int32)
    with pytest.raises(ValueError, match="other types or sizes"):
        _policy.act(np.zeros(5024 * 48, np.float32), widths, np.zeros(47, np.float32), np.zeros(5000), 0.0, 1.0)

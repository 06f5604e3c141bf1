"""The policy as the workers run it: a few matrix-vector products, without the library that trained it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot


def act(policy: PolicySnapshot, observation: NDArray[np.float32]) -> NDArray[np.float32]:
    """Canonical rest lengths [24] (m) that the policy commands without noise for an observation [47].

    Three hidden layers of tanh units (paper Sec. IV-C); the same numbers as the learner's network to float32 rounding.
    """
    hidden = observation
    for weight, bias in policy.layers[:-1]:
        hidden = weight @ hidden
        hidden += bias
        np.tanh(hidden, out=hidden)
    weight, bias = policy.layers[-1]
    return policy.offset_m + policy.scale_m * (weight @ hidden + bias)


def check(policy: PolicySnapshot, observation_n: int, action_n: int) -> PolicySnapshot:
    """Return `policy` when its layers fit together, are float32 and finite; DataError otherwise."""
    widths = [observation_n] + [len(bias) for _, bias in policy.layers]
    shapes = [weight.shape for weight, _ in policy.layers]
    if widths[-1] != action_n or shapes != [(out, into) for into, out in pairwise(widths)]:
        raise DataError(
            f"policy version {policy.version}: layers of shapes {shapes} do not lead from {observation_n} "
            f"observations to {action_n} actions; use a snapshot of this run"
        )
    for layer, arrays in enumerate(policy.layers):
        if not all(a.dtype == np.float32 and np.isfinite(a).all() for a in arrays):
            raise DataError(f"policy version {policy.version}: layer {layer} must hold finite float32 numbers")
    return policy

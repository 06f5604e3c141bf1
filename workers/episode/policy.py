"""The policy as the workers run it: a few products of matrices and vectors, without the library that trained it."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.episode import _policy

BLOCK = 32
"""Outputs that are computed side by side (workers/episode/native/policy.c)."""


@lru_cache(maxsize=2)
def ready(policy: PolicySnapshot) -> Callable[[NDArray[np.float32]], NDArray[np.float64]]:
    """The function from an observation [83] to the canonical rest lengths [24] (m) that the policy commands.

    A policy sees as many of its first entries as its first layer takes.
    There is no noise in it. Three hidden layers of tanh units (paper Sec. IV-C); the same numbers as the learner's
    network to float32 rounding.
    """
    parameters = np.concatenate([_packed(weight, bias) for weight, bias in policy.layers])
    widths = np.array([policy.layers[0][0].shape[1], *(len(bias) for _, bias in policy.layers)], dtype=np.int32)
    seen_n, commands_n = int(widths[0]), int(widths[-1])

    def act(observation: NDArray[np.float32]) -> NDArray[np.float64]:
        commands = np.empty(commands_n)
        _policy.act(parameters, widths, observation[:seen_n], commands, policy.offset_m, policy.scale_m)
        return commands

    return act


def _packed(weight: NDArray[np.float32], bias: NDArray[np.float32]) -> NDArray[np.float32]:
    """A layer block by block of outputs, the last one filled up with zeros: biases, then weights input by input."""
    blocks_n = -(-len(bias) // BLOCK)
    rows = np.zeros((blocks_n * BLOCK, weight.shape[1] + 1), dtype=np.float32)
    rows[: len(bias), 0], rows[: len(bias), 1:] = bias, weight
    return rows.reshape(blocks_n, BLOCK, -1).swapaxes(1, 2).ravel()


@lru_cache(maxsize=2)
def check(policy: PolicySnapshot, seen_n: tuple[int, ...], action_n: int) -> PolicySnapshot:
    """Return `policy` when its layers fit together, are float32 and finite; DataError otherwise.

    It may see so many entries of an observation as `seen_n` allows.
    """
    shapes = [weight.shape for weight, _ in policy.layers]
    widths = [shapes[0][-1]] + [len(bias) for _, bias in policy.layers]
    fits = widths[0] in seen_n and widths[-1] == action_n
    if not fits or shapes != [(out, into) for into, out in pairwise(widths)]:
        raise DataError(
            f"policy version {policy.version}: layers of shapes {shapes} do not lead from "
            f"{' or '.join(map(str, seen_n))} observations to {action_n} actions; use a snapshot of this run"
        )
    for layer, arrays in enumerate(policy.layers):
        if not all(a.dtype == np.float32 and np.isfinite(a).all() for a in arrays):
            raise DataError(f"policy version {policy.version}: layer {layer} must hold finite float32 numbers")
    return policy

"""S-step: training of the policy on observations and improved actions (paper Sec. II-A; Algorithm 2, line 13).

    minimise over theta   mean | network_theta(y) - (u* - offset) / scale |^2

from the current weights, by Adam with a step that decays to zero along half a cosine.

Every batch is divided into SHARDS parts, whose gradients are added in a fixed order. The parts run on threads; each
is computed as on one thread, so the result depends neither on the number of cores nor on which part is done first.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from t6gps.learner import policy
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.records import PolicySnapshot

SHARDS, THREADS_PER_SHARD = 2, 1
"""Fixed, since sums depend on how they are split: the same pairs must give the same weights on every machine."""


class Loss(NamedTuple):
    """Mean squared error over all pairs, in network units (scale_m squared), of the policy before and after."""

    before: float
    after: float


def train(
    snapshot: PolicySnapshot,
    observations: NDArray[np.float32],
    actions: NDArray[np.float32],
    settings: LearnerSettings,
    rng: np.random.Generator,
) -> Generator[tuple[int, int], None, tuple[PolicySnapshot, Loss]]:
    """Train on observations [n, ny] and actions u* [n, nu] (m), n >= 1.

    Yields (epochs done, epochs) and returns the next policy version with its loss. The result is a function of the
    arguments alone.
    """
    torch.set_num_threads(THREADS_PER_SHARD)
    inputs = torch.from_numpy(observations)
    targets = torch.from_numpy((actions - np.float32(snapshot.offset_m)) / np.float32(snapshot.scale_m))
    parameters, layers = policy.parameters(snapshot)
    optimiser = torch.optim.Adam([parameters], fused=True)
    batches = -(-len(inputs) // settings.batch)
    steps, step = settings.epochs * batches, 0
    before = _mean_squared_error(layers, inputs, targets)
    with ThreadPoolExecutor(SHARDS) as threads:
        for epoch in range(settings.epochs):
            for batch in np.array_split(rng.permutation(len(inputs)), batches):

                def shard_gradient(rows: NDArray[np.int64], batch_n: int = len(batch)) -> torch.Tensor:
                    chosen = torch.from_numpy(rows)
                    return gradient(layers, inputs[chosen], targets[chosen], batch_n)

                parts = list(threads.map(shard_gradient, np.array_split(batch, SHARDS)))
                parameters.grad = torch.stack(parts).sum(dim=0)
                decay = (1 + math.cos(math.pi * step / steps)) / 2
                optimiser.param_groups[0]["lr"] = settings.learning_rate * decay
                optimiser.step()
                step += 1
            yield epoch + 1, settings.epochs
    loss = Loss(before, _mean_squared_error(layers, inputs, targets))
    trained = tuple((weight.numpy().copy(), bias.numpy().copy()) for weight, bias in layers)
    return PolicySnapshot(snapshot.version + 1, trained, snapshot.offset_m, snapshot.scale_m), loss


def gradient(layers: policy.Layers, inputs: torch.Tensor, targets: torch.Tensor, batch_n: int) -> torch.Tensor:
    """What pairs [m, ny], [m, nu] add to the gradient of the mean squared error of their batch of `batch_n` pairs.

    One vector in the order of `policy.parameters`.
    """
    *entering, output = policy.activations(layers, inputs)
    back = (output - targets).mul_(2 / (batch_n * targets.shape[1]))
    parts: list[torch.Tensor] = []
    for number in reversed(range(len(layers))):
        parts += [back.sum(dim=0), (back.t() @ entering[number]).reshape(-1)]
        if number:
            back = (back @ layers[number][0]).mul_(1 - entering[number].square())
    return torch.cat(parts[::-1])


def _mean_squared_error(layers: policy.Layers, inputs: torch.Tensor, targets: torch.Tensor) -> float:
    total = 0.0
    for first in range(0, len(inputs), policy.ROWS):
        rows = slice(first, first + policy.ROWS)
        error = policy.activations(layers, inputs[rows])[-1] - targets[rows]
        total += float(error.square().sum(dtype=torch.float64))
    return total / targets.numel()

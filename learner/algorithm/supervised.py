"""S-step: training of the policy on observations and improved actions (paper Sec. II-A; Algorithm 2, line 13).

    minimise over theta   mean | network_theta(y) - (u* - offset) / scale |^2

from the current weights, by Adam with a step that decays to zero along half a cosine, on one thread: a gradient step is
a millisecond of many small products, in which two threads mostly wait for each other.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch.optim.adam import adam

from t6gps.learner import policy
from t6gps.learner.settings import LearnerSettings
from t6gps.storage.records import PolicySnapshot


class Moments(NamedTuple):
    """What Adam remembers of earlier gradients: steps taken [], averages of the gradient and of its square [n]."""

    step: torch.Tensor
    exp_avg: torch.Tensor
    exp_avg_sq: torch.Tensor


def no_moments(parameters: torch.Tensor) -> Moments:
    """Moments before the first step."""
    return Moments(torch.zeros(()), torch.zeros_like(parameters), torch.zeros_like(parameters))


def descend(
    parameters: torch.Tensor, gradient: torch.Tensor, moments: Moments, rate: float, weight_decay: float = 0.0
) -> None:
    """One step of Adam, or AdamW, in place: torch's own, but for its optimiser class, which takes a second to load."""
    adam(
        [parameters],
        [gradient],
        [moments.exp_avg],
        [moments.exp_avg_sq],
        [],
        [moments.step],
        fused=True,
        decoupled_weight_decay=True,
        amsgrad=False,
        maximize=False,
        beta1=0.9,
        beta2=0.999,
        eps=1e-8,
        lr=rate,
        weight_decay=weight_decay,
    )


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
    torch.set_num_threads(1)
    inputs = torch.from_numpy(observations)
    targets = torch.from_numpy((actions - np.float32(snapshot.offset_m)) / np.float32(snapshot.scale_m))
    parameters, layers = policy.parameters(snapshot)
    moments = no_moments(parameters)
    batches = -(-len(inputs) // settings.batch)
    steps = settings.epochs * batches
    before = _mean_squared_error(layers, inputs, targets)
    for epoch in range(settings.epochs):
        order = torch.from_numpy(rng.permutation(len(inputs)))
        for step, batch in enumerate(order.tensor_split(batches), epoch * batches):
            decay = (1 + math.cos(math.pi * step / steps)) / 2
            change = gradient(layers, inputs[batch], targets[batch], len(batch))
            descend(parameters, change, moments, settings.learning_rate * decay)
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
            back = torch.ops.aten.tanh_backward(back @ layers[number][0], entering[number])
    return torch.cat(parts[::-1])


def _mean_squared_error(layers: policy.Layers, inputs: torch.Tensor, targets: torch.Tensor) -> float:
    total = 0.0
    for first in range(0, len(inputs), policy.ROWS):
        rows = slice(first, first + policy.ROWS)
        error = policy.activations(layers, inputs[rows])[-1] - targets[rows]
        total += float(error.square().sum(dtype=torch.float64))
    return total / targets.numel()

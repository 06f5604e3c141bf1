"""S-step: training of the policy on observations and improved actions (Sec. II-A).

SupervisedLearning, line 13 of Algorithm 2:

    minimise over theta   mean | network_theta(y) - (u* - offset) / scale |^2

from the current weights, by Adam with a step that decays to zero along half a cosine, on one thread: a gradient step is
a millisecond of many small products, in which two threads mostly wait for each other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from typing import NamedTuple

import numpy as np
import torch
from torch.optim.adam import adam

from t6gps.learner import policy
from t6gps.learner.algorithm.pairs import Pairs, Several
from t6gps.learner.rows import Ints
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
    snapshot: PolicySnapshot, pairs: Pairs | Several, settings: LearnerSettings, rng: np.random.Generator
) -> Generator[tuple[int, int], None, tuple[PolicySnapshot, Loss]]:
    """Train on at least one pair of an observation [ny] and an action u* [nu] (m).

    Yields (epochs done, epochs) and returns the next policy version with its loss. The result is a function of the
    arguments alone.
    """
    torch.set_num_threads(1)

    def take(chosen: Ints) -> tuple[torch.Tensor, torch.Tensor]:
        observations, actions = pairs.take(chosen)
        targets = (actions - np.float32(snapshot.offset_m)) / np.float32(snapshot.scale_m)
        return torch.from_numpy(observations), torch.from_numpy(targets)

    parameters, layers = policy.parameters(snapshot)
    moments = no_moments(parameters)
    batches = -(-len(pairs) // settings.batch)
    steps = settings.epochs * batches
    before = _mean_squared_error(layers, take, len(pairs))
    for epoch in range(settings.epochs):
        order = rng.permutation(len(pairs))
        for step, batch in enumerate(np.array_split(order, batches), epoch * batches):
            decay = (1 + math.cos(math.pi * step / steps)) / 2
            change = gradient(layers, *take(batch), len(batch))
            descend(parameters, change, moments, settings.learning_rate * decay)
        yield epoch + 1, settings.epochs
    loss = Loss(before, _mean_squared_error(layers, take, len(pairs)))
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


def _mean_squared_error(
    layers: policy.Layers, take: Callable[[Ints], tuple[torch.Tensor, torch.Tensor]], pairs_n: int
) -> float:
    total, entries_n = 0.0, 0
    for first in range(0, pairs_n, policy.ROWS):
        inputs, targets = take(np.arange(first, min(first + policy.ROWS, pairs_n)))
        error = policy.activations(layers, inputs)[-1] - targets
        total += float(error.square().sum(dtype=torch.float64))
        entries_n += targets.numel()
    return total / entries_n

"""The policy network: fully connected, tanh between layers (paper Sec. IV-C), as a snapshot and in torch.

u = offset + scale * network(y)
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from t6gps.storage.records import PolicySnapshot

Layers = Sequence[tuple[torch.Tensor, torch.Tensor]]

FIRST_OUTPUT = 0.01
"""Size of the untrained network's output: the first policy holds the neutral shape and leaves motion to the noise."""
ROWS = 4096
"""Rows that pass the network at once: their activations stay in the cache."""


def initial(
    observation_n: int,
    action_n: int,
    hidden_layers: Sequence[int],
    rng: np.random.Generator,
    *,
    offset_m: float,
    scale_m: float,
) -> PolicySnapshot:
    """The untrained policy, version 0: weights of variance 1 / inputs, no biases, an output near zero."""
    widths = [observation_n, *hidden_layers, action_n]
    layers = []
    for inputs, outputs in pairwise(widths):
        weight = rng.standard_normal((outputs, inputs)) / np.sqrt(inputs)
        layers.append([weight, np.zeros(outputs)])
    layers[-1][0] *= FIRST_OUTPUT
    cast = tuple((weight.astype(np.float32), bias.astype(np.float32)) for weight, bias in layers)
    return PolicySnapshot(version=0, layers=cast, offset_m=offset_m, scale_m=scale_m)


def parameters(snapshot: PolicySnapshot) -> tuple[torch.Tensor, Layers]:
    """A copy of all weights and biases as one vector, and the (weight, bias) of each layer as views of it."""
    vector = torch.from_numpy(np.concatenate([array.ravel() for layer in snapshot.layers for array in layer]))
    layers, first = [], 0
    for weight, bias in snapshot.layers:
        middle, last = first + weight.size, first + weight.size + bias.size
        layers.append((vector[first:middle].view(weight.shape), vector[middle:last]))
        first = last
    return vector, layers


def activations(layers: Layers, inputs: torch.Tensor) -> list[torch.Tensor]:
    """What enters each layer [n, width], the inputs first, and the network's output [n, nu] last."""
    values = [inputs]
    for number, (weight, bias) in enumerate(layers, 1):
        value = torch.addmm(bias, values[-1], weight.t())
        values.append(value.tanh_() if number < len(layers) else value)
    return values


def act(snapshot: PolicySnapshot, observations: NDArray[np.float32]) -> NDArray[np.float32]:
    """Rest lengths [n, nu] (m) that the policy commands without noise, not clipped, for observations [n, ny]."""
    _, layers = parameters(snapshot)
    parts = [torch.tensor(observations[first : first + ROWS]) for first in range(0, len(observations), ROWS)]
    network: NDArray[np.float32] = torch.cat([activations(layers, part)[-1] for part in parts]).numpy()
    return np.float32(snapshot.offset_m) + np.float32(snapshot.scale_m) * network

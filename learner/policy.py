"""The policy network: fully connected, tanh between layers (paper Sec. IV-C), as a snapshot and as a torch module.

u = offset + scale * network(y)
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch

from t6gps.storage.records import PolicySnapshot

FIRST_OUTPUT = 0.01
"""Size of the untrained network's output: the first policy holds the neutral shape and leaves motion to the noise."""


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


def module(snapshot: PolicySnapshot) -> torch.nn.Sequential:
    """A trainable copy of the snapshot's network, without offset and scale."""
    parts: list[torch.nn.Module] = []
    for weight, bias in snapshot.layers:
        linear = torch.nn.Linear(weight.shape[1], weight.shape[0])
        with torch.no_grad():
            linear.weight.copy_(torch.tensor(weight))
            linear.bias.copy_(torch.tensor(bias))
        parts += [linear, torch.nn.Tanh()]
    return torch.nn.Sequential(*parts[:-1])


def snapshot(network: torch.nn.Sequential, *, version: int, offset_m: float, scale_m: float) -> PolicySnapshot:
    """A copy of the network's weights as version `version`."""
    layers = tuple(
        (layer.weight.detach().numpy().copy(), layer.bias.detach().numpy().copy())
        for layer in network
        if isinstance(layer, torch.nn.Linear)
    )
    return PolicySnapshot(version=version, layers=layers, offset_m=offset_m, scale_m=scale_m)

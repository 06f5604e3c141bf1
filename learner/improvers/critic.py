"""A network that learns an action value, its slowly following copy, and what its optimiser remembers."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import torch

from t6gps.learner import policy
from t6gps.learner.algorithm import supervised
from t6gps.learner.improvers.transitions import INPUTS_N
from t6gps.learner.port import Arrays
from t6gps.learner.rows import AnyArray
from t6gps.learner.settings import ActionValueSettings


class Critic:
    """Q of inputs [s; e] [m, ni] as one network."""

    def __init__(self, settings: ActionValueSettings, rng: np.random.Generator) -> None:
        self._settings = settings
        first = policy.initial(INPUTS_N, 1, settings.hidden_layers, rng, offset_m=0.0, scale_m=1.0)
        self._vector, self._layers = policy.parameters(first)
        self._target, self._target_layers = policy.parameters(first)
        self._moments = supervised.no_moments(self._vector)

    @property
    def has_learned(self) -> bool:
        """It has taken a gradient step."""
        return bool(self._moments.step)

    def step(self, before: torch.Tensor, wanted: torch.Tensor) -> None:
        """One gradient step towards wanted values [m, 1] of inputs [m, ni]; the copy follows."""
        settings = self._settings
        change = supervised.gradient(self._layers, before, wanted, len(before))
        supervised.descend(self._vector, change, self._moments, settings.learning_rate, settings.weight_decay)
        self._target.lerp_(self._vector, settings.target_rate)

    def values(self, inputs: torch.Tensor) -> torch.Tensor:
        """Q [m, 1] of inputs [m, ni] (m/s)."""
        return policy.activations(self._layers, inputs)[-1]

    def target_values(self, inputs: torch.Tensor) -> torch.Tensor:
        """The same by the slowly following copy."""
        return policy.activations(self._target_layers, inputs)[-1]

    def gradient(self, inputs: torch.Tensor) -> torch.Tensor:
        """dQ / d inputs [m, ni] at inputs [m, ni]."""
        values = policy.activations(self._layers, inputs)
        back = self._layers[-1][0].expand(len(inputs), -1)
        for number in reversed(range(len(self._layers) - 1)):
            back = torch.ops.aten.tanh_backward(back, values[number + 1]) @ self._layers[number][0]
        return back

    def arrays(self) -> Arrays:
        """What it goes on from."""
        tensors = {"learned": self._vector, "target": self._target} | self._moments._asdict()
        return {name: tensor.numpy().copy() for name, tensor in tensors.items()}

    def restore(self, arrays: Mapping[str, AnyArray]) -> None:
        """Continue from `arrays()`. KeyError when an entry is missing."""
        self._vector.copy_(torch.from_numpy(arrays["learned"]))
        self._target.copy_(torch.from_numpy(arrays["target"]))
        names = supervised.Moments._fields
        self._moments = supervised.Moments(*(torch.from_numpy(arrays[name]) for name in names))

"""Policies as TorchScript: a module that is traced through `decision.decide`. Its extra file holds the description."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import final

import torch

from t6gps.service.policies import tables
from t6gps.service.policies.decision import Inputs, Network, decide
from t6gps.service.policies.description import Description, digest, read
from t6gps.service.policies.driver import Array, Measurement, State
from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.settings import RobotSettings

EXTRA = "t6gps.json"
"""Name of the extra file."""
SHAPES = {
    "nodes": (12, 3),
    "com_velocity": (3,),
    "bar_angular_velocities": (6, 3),
    "rest_lengths": (24,),
    "waypoint": (2,),
}


class _Ops:
    """The operations of `decision.Ops` in torch."""

    def take(self, x: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
        return x[index]

    def pick(self, x: torch.Tensor, column: int) -> torch.Tensor:
        return x[..., column]

    def sum(self, x: torch.Tensor) -> torch.Tensor:
        return x.sum(0)

    def argmin(self, x: torch.Tensor) -> torch.Tensor:
        return x.argmin(0)

    def where(self, condition: torch.Tensor, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        return torch.where(condition, x, y)

    def sqrt(self, x: torch.Tensor) -> torch.Tensor:
        return x.sqrt()

    def clip(self, x: torch.Tensor, low: float, high: float) -> torch.Tensor:
        return x.clip(low, high)

    def stack(self, parts: Sequence[torch.Tensor]) -> torch.Tensor:
        return torch.stack(list(parts), -1)

    def joined(self, parts: Sequence[torch.Tensor]) -> torch.Tensor:
        return torch.cat([part.flatten() for part in parts])

    def single(self, x: torch.Tensor) -> torch.Tensor:
        return x.float()

    def double(self, x: torch.Tensor) -> torch.Tensor:
        return x.double()

    def first(self, x: torch.Tensor, n: int) -> torch.Tensor:
        return x[:n]

    def product(self, matrix: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
        return matrix @ vector

    def tanh(self, x: torch.Tensor) -> torch.Tensor:
        return x.tanh()


class _Decision(torch.nn.Module):
    """One decision: a tensor for each input of NUMBERS, in that order, to commands and the next state."""

    def __init__(self, policy: PolicySnapshot, robot: RobotSettings) -> None:
        super().__init__()
        self._policy, self._robot = policy, robot
        for name, values in (*tables.INTS.items(), *tables.FLOATS.items()):
            self.register_buffer(name, torch.from_numpy(values.copy()))
        for number, (weight, bias) in enumerate(policy.layers):
            self.register_buffer(f"weight_{number}", torch.from_numpy(weight.copy()))
            self.register_buffer(f"bias_{number}", torch.from_numpy(bias.copy()))

    def forward(
        self,
        nodes: torch.Tensor,
        com_velocity: torch.Tensor,
        bar_angular_velocities: torch.Tensor,
        rest_lengths: torch.Tensor,
        waypoint: torch.Tensor,
        state: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        policy, held = self._policy, dict(self.named_buffers())
        network = Network(
            [(held[f"weight_{number}"], held[f"bias_{number}"]) for number in range(len(policy.layers))],
            policy.layers[0][0].shape[1],
            policy.offset_m,
            policy.scale_m,
            self._robot.shortest_command_m,
            self._robot.longest_command_m,
        )
        given = Inputs(nodes, com_velocity, bar_angular_velocities, rest_lengths, waypoint, state)
        return decide(_Ops(), held, given, network)


def write(policy: PolicySnapshot, robot: RobotSettings, description: Description, file: Path) -> None:
    """Write a policy as TorchScript."""
    example = [torch.ones(shape, dtype=torch.float64) for shape in SHAPES.values()]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch advises torch.export, which C++ cannot load alone
        inputs = (*example, torch.tensor([-1, -1]))
        traced = torch.jit.trace(_Decision(policy, robot), inputs, check_trace=False)  # type: ignore[no-untyped-call]
        torch.jit.save(traced, str(file), _extra_files={EXTRA: description.to_json()})


@final
class TorchScriptDriver:
    """A policy in a file of TorchScript. DataError where it is none, or fails its SHA-256."""

    def __init__(self, file: Path) -> None:
        extra = {EXTRA: ""}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)
                self._module = torch.jit.load(  # type: ignore[no-untyped-call]
                    str(file), map_location="cpu", _extra_files=extra
                )
        except (RuntimeError, ValueError) as error:
            reason = str(error).splitlines()[0]
            raise DataError(f"{file} is no TorchScript: {reason}; export the policy again") from None
        self.description = read(extra[EXTRA] or "{}", file)
        held = {name: values.numpy() for name, values in self._module.named_buffers()}
        layers_n = sum(name.startswith("weight_") for name in held)
        layers = tuple((held[f"weight_{n}"], held[f"bias_{n}"]) for n in range(layers_n))
        found = PolicySnapshot(self.description.policy_version, layers, 0.0, 0.0)
        if not layers or digest(found) != self.description.sha256:
            raise DataError(f"{file}: the weights fail their SHA-256; export the policy again")

    def decide(self, measured: Measurement, state: State) -> tuple[Array, State]:
        """As `driver.Driver`."""
        values = [torch.from_numpy(getattr(measured, name)) for name in SHAPES]
        with torch.inference_mode():
            commands, after = self._module(*values, torch.from_numpy(state))
        return commands.numpy(), after.numpy()

"""Policies as ONNX: `decision.decide` written down as a graph, node by node. Its metadata hold the description.

The graph is written by hand: torch's exporters are either deprecated, or bring two more libraries and note the paths of
this machine in every node. The same policy gives the same bytes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import numpy as np
import onnx
import onnxruntime
from google.protobuf.message import DecodeError
from onnx import TensorProto, helper, numpy_helper
from onnxruntime.capi import onnxruntime_pybind11_state as states

from t6gps.service.policies import tables
from t6gps.service.policies.decision import Inputs, Network, decide
from t6gps.service.policies.description import Description, digest, read
from t6gps.service.policies.driver import Array, Measurement, State
from t6gps.service.policies.onnx_graph import Graph, Value
from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.settings import RobotSettings

KEY = "t6gps"
"""The metadata property that holds the description; others repeat its single entries for those who look."""
OPSET, IR_VERSION = 17, 8
"""What runtimes from 2022 on read."""
INPUTS = {
    "nodes": (TensorProto.DOUBLE, (12, 3)),
    "com_velocity": (TensorProto.DOUBLE, (3,)),
    "bar_angular_velocities": (TensorProto.DOUBLE, (6, 3)),
    "rest_lengths": (TensorProto.DOUBLE, (24,)),
    "waypoint": (TensorProto.DOUBLE, (2,)),
    "state": (TensorProto.INT64, (2,)),
}
OUTPUTS = {"commands": (TensorProto.DOUBLE, (24,)), "next_state": (TensorProto.INT64, (2,))}
REFUSALS = (
    DecodeError,
    states.Fail,
    states.InvalidArgument,
    states.InvalidGraph,
    states.InvalidProtobuf,
    states.NotImplemented,
    states.RuntimeException,
)
"""What the two libraries raise for a file that is no model; these classes have no base of their own."""
DTYPES: Mapping[int, type[np.generic]] = {TensorProto.DOUBLE: np.float64, TensorProto.INT64: np.int64}


@dataclass(frozen=True)
class _Ops:
    """The operations of `decision.Ops` as nodes."""

    graph: Graph

    def take(self, x: Value, index: Value) -> Value:
        return self.graph.node("Gather", x, index, axis=0)

    def pick(self, x: Value, column: int) -> Value:
        return self.graph.node("Gather", x, self.graph.constant(np.array(column)), axis=-1)

    def sum(self, x: Value) -> Value:
        return self.graph.node("ReduceSum", x, self.graph.constant(np.array([0])), keepdims=0)

    def argmin(self, x: Value) -> Value:
        return self.graph.node("ArgMin", x, dtype=np.int64, axis=0, keepdims=0)

    def where(self, condition: Value, x: Value, y: Value) -> Value:
        return self.graph.node("Where", condition, x, y, dtype=x.dtype)

    def sqrt(self, x: Value) -> Value:
        return self.graph.node("Sqrt", x)

    def clip(self, x: Value, low: float, high: float) -> Value:
        bounds = (self.graph.constant(np.array(bound, x.dtype)) for bound in (low, high))
        return self.graph.node("Clip", x, *bounds)

    def stack(self, parts: Sequence[Value]) -> Value:
        last = self.graph.constant(np.array([-1]))
        return self.graph.node("Concat", *(self.graph.node("Unsqueeze", part, last) for part in parts), axis=-1)

    def joined(self, parts: Sequence[Value]) -> Value:
        flat = self.graph.constant(np.array([-1]))
        return self.graph.node("Concat", *(self.graph.node("Reshape", part, flat) for part in parts), axis=0)

    def single(self, x: Value) -> Value:
        return self.graph.node("Cast", x, dtype=np.float32, to=TensorProto.FLOAT)

    def double(self, x: Value) -> Value:
        return self.graph.node("Cast", x, dtype=np.float64, to=TensorProto.DOUBLE)

    def first(self, x: Value, n: int) -> Value:
        return self.graph.node("Slice", x, *(self.graph.constant(np.array([bound])) for bound in (0, n)))

    def product(self, matrix: Value, vector: Value) -> Value:
        return self.graph.node("MatMul", matrix, vector)

    def tanh(self, x: Value) -> Value:
        return self.graph.node("Tanh", x)


def write(policy: PolicySnapshot, robot: RobotSettings, description: Description, file: Path) -> None:
    """Write a policy as ONNX."""
    graph = Graph()
    table = {name: graph.constant(values, name) for name, values in {**tables.INTS, **tables.FLOATS}.items()}
    layers = [
        (graph.constant(weight, f"weight_{number}"), graph.constant(bias, f"bias_{number}"))
        for number, (weight, bias) in enumerate(policy.layers)
    ]
    network = Network(
        layers,
        policy.layers[0][0].shape[1],
        policy.offset_m,
        policy.scale_m,
        robot.shortest_command_m,
        robot.longest_command_m,
    )
    given = Inputs(**{name: Value(graph, name, DTYPES[kind]) for name, (kind, _) in INPUTS.items()})
    outputs = decide(_Ops(graph), table, given, network)
    for value, name in zip(outputs, OUTPUTS, strict=True):
        graph.nodes.append(helper.make_node("Identity", [value.name], [name]))
    model = helper.make_model(
        helper.make_graph(graph.nodes, "decision", _infos(INPUTS), _infos(OUTPUTS), [*graph.constants.values()]),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name=description.made_by,
    )
    helper.set_model_props(model, {KEY: description.to_json(), **_plain(description)})
    onnx.checker.check_model(model, full_check=True)
    file.write_bytes(model.SerializeToString(deterministic=True))


def _infos(values: Mapping[str, tuple[int, tuple[int, ...]]]) -> list[onnx.ValueInfoProto]:
    return [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in values.items()]


def _plain(description: Description) -> dict[str, str]:
    """Entries of the description that are one text or number."""
    values = description.model_dump(mode="json")
    return {name: str(value) for name, value in values.items() if isinstance(value, str | int | float)}


@final
class OnnxDriver:
    """A policy in a file of ONNX, run by ONNX Runtime. DataError where it is none, or fails its SHA-256."""

    def __init__(self, file: Path) -> None:
        content = file.read_bytes()
        try:
            model = onnx.load_from_string(content)
            options = onnxruntime.SessionOptions()
            options.intra_op_num_threads = options.inter_op_num_threads = 1
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except REFUSALS as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise DataError(f"{file} is no ONNX model: {reason}; export the policy again") from None
        properties = {entry.key: entry.value for entry in model.metadata_props}
        self.description = read(properties.get(KEY, "{}"), file)
        held = {constant.name: constant for constant in model.graph.initializer}
        layers = tuple(
            (numpy_helper.to_array(held[f"weight_{n}"]), numpy_helper.to_array(held[f"bias_{n}"]))
            for n in range(sum(name.startswith("weight_") for name in held))
        )
        found = PolicySnapshot(self.description.policy_version, layers, 0.0, 0.0)
        if not layers or digest(found) != self.description.sha256:
            raise DataError(f"{file}: the weights fail their SHA-256; export the policy again")

    def decide(self, measured: Measurement, state: State) -> tuple[Array, State]:
        """As `driver.Driver`."""
        commands, after = self._session.run(None, {**vars(measured), "state": state})
        return commands, after

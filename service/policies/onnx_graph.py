"""A graph of ONNX that grows as values are computed with: arithmetic between them adds nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np
import onnx
from onnx import helper, numpy_helper

Number = int | float


class Graph:
    """Nodes and constants, each with a name of its own."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: dict[str, onnx.TensorProto] = {}

    def node(self, kind: str, *inputs: Value, dtype: type[np.generic] | None = None, **attributes: int) -> Value:
        """The output of a new node, of the type of its first input unless another is given."""
        name = f"v{len(self.nodes)}"
        node = helper.make_node(kind, [value.name for value in inputs], [name])
        node.attribute.extend(helper.make_attribute(key, value) for key, value in attributes.items())
        self.nodes.append(node)
        return Value(self, name, inputs[0].dtype if dtype is None else dtype)

    def constant(self, values: np.ndarray[tuple[int, ...], np.dtype[np.generic]], name: str = "") -> Value:
        """A constant; those without a name are called after what they hold."""
        name = name or f"{values.dtype}_{'_'.join(map(str, values.ravel().tolist()))}_{values.ndim}"
        self.constants[name] = numpy_helper.from_array(values.copy(), name)
        return Value(self, name, values.dtype.type)


@final
@dataclass(frozen=True, eq=False)
class Value:
    """What a node of a graph gives, or one of its constants; arithmetic adds nodes."""

    graph: Graph
    name: str
    dtype: type[np.generic]

    def _with(self, kind: str, other: Value | Number, dtype: type[np.generic] | None = None) -> Value:
        value = other if isinstance(other, Value) else self.graph.constant(np.array(other, self.dtype))
        return self.graph.node(kind, self, value, dtype=dtype)

    def __add__(self, other: Value | Number) -> Value:
        return self._with("Add", other)

    def __sub__(self, other: Value | Number) -> Value:
        return self._with("Sub", other)

    def __mul__(self, other: Value | Number) -> Value:
        return self._with("Mul", other)

    def __truediv__(self, other: Value | Number) -> Value:
        return self._with("Div", other)

    def __lt__(self, other: Value | Number) -> Value:
        return self._with("Less", other, np.bool_)

    def __le__(self, other: Value | Number) -> Value:
        return self._with("LessOrEqual", other, np.bool_)

    def __ge__(self, other: Value | Number) -> Value:
        return self._with("GreaterOrEqual", other, np.bool_)

    def __and__(self, other: Value) -> Value:
        return self._with("And", other)

    def __or__(self, other: Value) -> Value:
        return self._with("Or", other)

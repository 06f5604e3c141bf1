"""A decision, from what is measured to the commands of the cables, for any library of arrays.

It is `support.support_face`, `support.enter`, `symmetry.frame_yaw`, `observation.observe` and the policy's network in
one function without branches: a choice is a row of a constant table (`tables`). Geometry is computed with 64 bits, as
in the simulator, and the network with 32. `policy.h` computes the same in C. A number that is not finite gives commands
that are NaN, and leaves the state.

x, y, z    places of the nodes about the centre of mass, z above the ground's zero [12] (m)
g, f       symmetry element of the frame, support triangle
c, s       cosine and sine of the turn of the frame
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from t6gps.storage.schema import NODE_SCALE_M, REST_LENGTH_SCALE_M, SENSORS_N
from t6gps.workers.robot.observation import ANGULAR_VELOCITY_SCALE_RAD_PER_S, FARTHEST_NODE, SLOWEST_TRACK_M_PER_S
from t6gps.workers.robot.topology import NODES_N

if TYPE_CHECKING:
    import torch

    from t6gps.service.policies.onnx_graph import Value

T = TypeVar("T", "torch.Tensor", "Value")
FAR_M = 1e9
"""Farther than anything is."""
NEAREST_WAYPOINT_M = 1e-9
"""At the waypoint itself no direction leads to it, and that of the observation is zero."""


class Ops(Protocol[T]):
    """What a library of arrays does beside arithmetic and comparisons."""

    def take(self, x: T, index: T) -> T:
        """Entries of the first axis."""

    def pick(self, x: T, column: int) -> T:
        """One entry of the last axis."""

    def sum(self, x: T) -> T:
        """Sum over the first axis."""

    def argmin(self, x: T) -> T:
        """Where a vector is least, first."""

    def where(self, condition: T, x: T, y: T) -> T: ...

    def sqrt(self, x: T) -> T: ...

    def clip(self, x: T, low: float, high: float) -> T: ...

    def stack(self, parts: Sequence[T]) -> T:
        """Side by side, along a new last axis."""

    def joined(self, parts: Sequence[T]) -> T:
        """One vector after the other, each flattened."""

    def single(self, x: T) -> T:
        """With 32 bits."""

    def double(self, x: T) -> T:
        """With 64 bits."""

    def first(self, x: T, n: int) -> T:
        """The first entries of a vector."""

    def product(self, matrix: T, vector: T) -> T: ...

    def tanh(self, x: T) -> T: ...


@dataclass(frozen=True)
class Inputs(Generic[T]):
    """What a decision depends on; units and frames are those of `driver.Measurement`. `state` [2] is f, g before."""

    nodes: T
    com_velocity: T
    bar_angular_velocities: T
    rest_lengths: T
    waypoint: T
    state: T


@dataclass(frozen=True)
class Network(Generic[T]):
    """The policy's layers, each [out, in] and [out], how many entries it sees, and rest lengths of its outputs (m)."""

    layers: Sequence[tuple[T, T]]
    seen_n: int
    offset_m: float
    scale_m: float
    shortest_m: float
    longest_m: float


def decide(ops: Ops[T], table: Mapping[str, T], given: Inputs[T], network: Network[T]) -> tuple[T, T]:
    """Commanded rest lengths [24] (m) in the cables' own order, and the state [2] for the next decision."""
    com = ops.sum(given.nodes) / NODES_N
    x = ops.pick(given.nodes, 0) - ops.pick(com, 0)
    y = ops.pick(given.nodes, 1) - ops.pick(com, 1)
    z, height = ops.pick(given.nodes, 2), ops.pick(com, 2)
    f = _face(ops, table, x, y, z, height)
    g = _element(ops, table, given.state, f, x, y)
    kind, side = ops.take(table["kinds"], f), ops.take(table["side"], g)
    c, s = _turn(ops, table, g, kind, side, x, y)
    gap = (ops.pick(given.waypoint, 0) - ops.pick(com, 0), ops.pick(given.waypoint, 1) - ops.pick(com, 1))
    velocity = (ops.pick(given.com_velocity, 0), ops.pick(given.com_velocity, 1))
    parts = [
        ops.stack([ops.double(kind)]),
        (ops.take(given.rest_lengths, ops.take(table["cables_from"], g)) - network.offset_m) / REST_LENGTH_SCALE_M,
        _turned_bars(ops, table, g, side, c, s, given.bar_angular_velocities),
        _turned_way(ops, side, c, s, gap, NEAREST_WAYPOINT_M),
        _turned_way(ops, side, c, s, velocity, SLOWEST_TRACK_M_PER_S),
    ]
    if network.seen_n > SENSORS_N:
        parts.append(_turned_nodes(ops, table, g, side, c, s, (x, y, z - height)))
    commands = _commands(ops, network, ops.single(ops.joined(parts)))
    lost = _lost(ops, given)
    after = ops.where(lost >= 0, ops.stack([f, g]), given.state)
    return ops.take(commands, ops.take(table["cable_map"], g)) + lost, after


def _lost(ops: Ops[T], given: Inputs[T]) -> T:
    """Zero, or NaN where a number that is measured is not finite."""
    measured = [given.nodes, given.com_velocity, given.bar_angular_velocities, given.rest_lengths, given.waypoint]
    return ops.sum(ops.joined(measured) * 0)


def _face(ops: Ops[T], table: Mapping[str, T], x: T, y: T, z: T, height: T) -> T:
    """The support triangle, as `support.support_face`."""
    corners = [ops.pick(table["faces"], corner) for corner in range(3)]
    xs, ys, zs = ([ops.take(values, corner) for corner in corners] for values in (x, y, z))
    a, b, c = (xs[i] * ys[j] - xs[j] * ys[i] for i, j in ((1, 2), (2, 0), (0, 1)))
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    crossing = (a * zs[0] + b * zs[1] + c * zs[2]) / (a + b + c)
    below = inside & (crossing < height)
    lowest = ops.argmin(ops.where(below, crossing, height + FAR_M))
    return ops.where(ops.take(below, lowest), lowest, ops.argmin(zs[0] + zs[1] + zs[2]))


def _element(ops: Ops[T], table: Mapping[str, T], before: T, f: T, x: T, y: T) -> T:
    """Symmetry element of the frame, as `support.enter`."""
    known = ops.take(ops.take(ops.take(table["transition"], ops.pick(before, 0)), ops.pick(before, 1)), f)
    corners = [ops.pick(ops.take(table["faces"], f), corner) for corner in range(3)]
    distances = []
    for a, b in ((0, 1), (1, 2), (2, 0)):
        start_x, start_y = ops.take(x, corners[a]), ops.take(y, corners[a])
        along_x, along_y = ops.take(x, corners[b]) - start_x, ops.take(y, corners[b]) - start_y
        area = along_x * start_y - along_y * start_x
        distances.append(ops.sqrt(area * area / (along_x * along_x + along_y * along_y)))
    edge = ops.argmin(ops.stack(distances) + ops.take(table["barred"], f))
    return ops.where(known >= 0, known, ops.take(ops.take(table["element_by_edge"], f), edge))


def _turn(ops: Ops[T], table: Mapping[str, T], g: T, kind: T, side: T, x: T, y: T) -> tuple[T, T]:
    """Cosine and sine of the turn of the frame, as `symmetry.frame_yaw`."""
    corners = ops.take(ops.take(table["corners_from"], g), kind)
    xs, ys = ops.take(x, corners), ops.take(y, corners) * side
    xs, ys = xs - ops.sum(xs) / 3, ys - ops.sum(ys) / 3
    goal = ops.take(table["reference_triangles"], kind)
    goal_x, goal_y = ops.pick(goal, 0), ops.pick(goal, 1)
    twist, along = ops.sum(xs * goal_y - ys * goal_x), ops.sum(xs * goal_x + ys * goal_y)
    size = ops.sqrt(twist * twist + along * along)
    return along / size, twist / size


def _turned_way(ops: Ops[T], side: T, c: T, s: T, vector: tuple[T, T], least: float) -> T:
    """Canonical horizontal vector [2] over its length, which counts as `least` where it is shorter."""
    x, y = vector
    length = ops.clip(ops.sqrt(x * x + y * y), least, FAR_M)
    x, y = x / length, y / length * side
    return ops.stack([x * c - y * s, x * s + y * c])


def _turned_bars(ops: Ops[T], table: Mapping[str, T], g: T, side: T, c: T, s: T, velocities: T) -> T:
    """Canonical angular velocities [6, 3]; a mirror maps these pseudo-vectors by det(W) W."""
    chosen = ops.take(velocities, ops.take(table["bars_from"], g)) / ANGULAR_VELOCITY_SCALE_RAD_PER_S
    x, y, z = (ops.pick(chosen, axis) for axis in range(3))
    return ops.stack([x * c * side - y * s, x * s * side + y * c, z * side])


def _turned_nodes(ops: Ops[T], table: Mapping[str, T], g: T, side: T, c: T, s: T, places: tuple[T, T, T]) -> T:
    """Canonical nodes about the centre of mass [12, 3]."""
    chosen = ops.take(table["nodes_from"], g)
    x, y, z = (ops.take(values, chosen) / NODE_SCALE_M for values in places)
    y = y * side
    return ops.clip(ops.stack([x * c - y * s, x * s + y * c, z]), -FARTHEST_NODE, FARTHEST_NODE)


def _commands(ops: Ops[T], network: Network[T], observation: T) -> T:
    """Canonical rest lengths [24] (m) within the range of commands."""
    values = ops.first(observation, network.seen_n)
    for number, (weight, bias) in enumerate(network.layers, 1):
        values = ops.product(weight, values) + bias
        if number < len(network.layers):
            values = ops.tanh(values)
    commands = ops.double(values * network.scale_m + network.offset_m)
    return ops.clip(commands, network.shortest_m, network.longest_m)

"""Rows of an iteration: what the C-step and the S-step read of its episodes.

Episodes lie one under another in ascending order of their ids, so that nothing depends on the order of arrival.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]
AnyArray = NDArray[Any]
Columns = dict[str, AnyArray]
"""Entries of rows [n, ...] by the name of their column."""

NONE = -1
"""Stands for an edge that is null in the table."""

VELOCITY_N = 3
"""The cost state: the first entries of every reduced state are the centre of mass velocity."""

PIECE_ROWS = 2**17
"""Rows that are handled at once where all of them would need memory many times over, as in double precision.

A sum over more rows is the sum of its pieces and rounds otherwise than that over all of them at once. Iterations of the
paper's size (75,000 steps) are one piece.
"""


@dataclass(frozen=True)
class Rows:
    """Rows of all episodes, n in all.

    state         reduced state [n, nx], centre of mass velocity first (m/s, m)
    action        commanded rest lengths [n, nu], NaN on the last row of an episode (m)
    action_mean   the same without exploration noise (m)
    target        horizontal unit vector to the waypoint [n, 2]
    observation   what the policy saw [n, ny]
    noise_std_m   exploration noise that the episode was planned with [n]
    kind, entry, exit   of the support triangle [n], NONE for a null edge
    starts        the row is the first one on its support triangle [n]
    acts          the row has an action [n]
    continues     the transition to the next row is a sample of the dynamics [n]: not after the last row of an
                  episode, nor over a jump between triangles without a common edge
    labels        canonical label of each entry of an action [n, nu] where actions are not canonical, else None
    reach_m       farthest that a winch comes in a control step where models regress on what it reaches of a command,
                  else None; the state ends in the rest lengths then
    """

    state: Floats
    action: Floats
    action_mean: Floats
    target: Floats
    observation: Floats
    noise_std_m: Floats
    kind: Ints
    entry: Ints
    exit: Ints
    starts: Flags
    acts: Flags
    continues: Flags
    labels: Ints | None = None
    reach_m: float | None = None

    def samples(self, chosen: Ints) -> Floats:
        """Joint vectors [x; u; x'] of rows [m] that continue, and of the rows below them [m, 2 nx + nu]."""
        return np.hstack([self.state[chosen], self.regressor(chosen, self.action[chosen]), self.state[chosen + 1]])

    def regressor(self, chosen: Ints, action: Floats) -> Floats:
        """What models regress on for actions [..., nu] (m) at rows [...]: those, or what winches reach in -1 .. 1."""
        if self.reach_m is None:
            return action
        rest_lengths = self.state[chosen, -action.shape[-1] :]
        reached: Floats = np.clip((action - rest_lengths) / np.float32(self.reach_m), -1, 1)
        return reached


def pieces(chosen: Ints, size: int = PIECE_ROWS) -> list[Ints]:
    """Row numbers in pieces of at most `size`; a single empty one when there are none."""
    return [chosen[first : first + size] for first in range(0, max(len(chosen), 1), size)]


def root_mean_square(chosen: Ints, values: Callable[[Ints], Floats]) -> float:
    """Root of the mean square of all entries of `values` at rows [m], m >= 1, which are asked for in pieces."""
    total, entries_n = 0.0, 0
    for piece in pieces(chosen):
        squares = np.square(values(piece), dtype=np.float64)
        total, entries_n = total + squares.sum(), entries_n + squares.size
    return float(np.sqrt(total / entries_n))

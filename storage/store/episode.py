"""An episode as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import final

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from t6gps.storage.store import arrays


@final
@dataclass(frozen=True, eq=False)
class StoredEpisode(Mapping[str, NDArray[np.generic]]):
    """One episode: its frames by column, each an array [T + 1, *shape], such as `nodes` [T + 1, 12, 3].

    `action` and `action_mean` are [T, 24], since no action follows the last state. Units are in `frames.schema`.

    frames    the rows of the table `frames`
    summary   its row of the table `episodes`
    """

    frames: pa.Table
    summary: Mapping[str, object]

    @property
    def steps(self) -> int:
        """Control steps T."""
        return self.frames.num_rows - 1

    def __getitem__(self, name: str) -> NDArray[np.generic]:
        if name not in self.frames.column_names:
            raise KeyError(f"{name}; columns: {', '.join(self.frames.column_names)}")
        column = self.frames.column(name)
        return arrays.array(name, column.drop_null() if pa.types.is_list(column.type) else column)

    def __iter__(self) -> Iterator[str]:
        return iter(self.frames.column_names)

    def __len__(self) -> int:
        return len(self.frames.column_names)

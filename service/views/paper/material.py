"""What the figures of a run are drawn from."""

from __future__ import annotations

from dataclasses import dataclass

import pyarrow as pa

from t6gps.service.config import Config
from t6gps.storage.records import Episode
from t6gps.workers.ground.ground import ground
from t6gps.workers.ground.terrain import Terrain

FRAME_COLUMNS = ("episode_id", "step", "face", "kind", "entry_edge", "exit_edge", "forward_speed_m_per_s")
"""What figures of many episodes read of their frames."""
MODEL_COLUMNS = (
    "iteration", "bin", "kind", "entry_edge", "exit_edge", "truncated", "pooled", "step", "mode", "samples", "residual",
)  # fmt: skip
"""What they read of the table `models`."""


@dataclass(frozen=True, kw_only=True)
class Material:
    """A run, one of its evaluations, and the episode of it that is shown.

    config            the world of the evaluation; what the run itself was trained with, but for that
    iterations        the table `iterations`, ascending
    sampled           forward speeds (m/s) of the samples of the last iteration: the column of `frames`
    models            MODEL_COLUMNS of the last iteration that has models; no row where none has
    evaluation        its row of `evaluations`
    episodes          the rows of `evaluation_episodes` that are its
    frames            FRAME_COLUMNS of these episodes, by episode and step
    shown             the episode that is shown, with all its columns
    """

    run: str
    config: Config
    iterations: pa.Table
    sampled: pa.Table
    models: pa.Table
    evaluation: pa.Table
    episodes: pa.Table
    frames: pa.Table
    shown: Episode

    @property
    def terrain(self) -> Terrain | None:
        """The ground of the shown episode, None for the plane."""
        row = self.shown.summary.to_pylist()[0]
        return ground(self.config.terrain, row["terrain_seed"], row["terrain_difficulty"])

    @property
    def title(self) -> str:
        """Names the shown episode."""
        number = self.evaluation["evaluation_id"][0].as_py()
        return f"{self.run}, evaluation {number}, episode {self.shown.episode_id}"

"""What stores are measured with: episodes of the simulated robot, and the same under the numbers of any iteration."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from itertools import pairwise

import numpy as np
import pyarrow as pa

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.bench import replay
from t6gps.service.bench.contenders import PRESET
from t6gps.service.bench.rounds import Say
from t6gps.service.execution.wiring import new_learner
from t6gps.storage import schema
from t6gps.storage.fields import vector_length
from t6gps.storage.records import Episode, Learned, PolicySnapshot
from t6gps.workers.worker import RolloutWorker

SAID_EVERY_N = 50


def simulated(episodes_n: int, say: Say) -> list[Episode]:
    """Episodes of PRESET with the untrained policy: how well columns shrink depends on what is in them."""
    config = configuration.load(PRESET, ["run.workers=1", f"run.episodes={episodes_n}"])
    policy, episodes = new_learner(config).policy(), list[Episode]()
    with closing(RolloutWorker(config.rollout)) as worker:
        for plan in seeding.training_plans(config, 0):
            episodes.append(worker.run(plan, policy))
            if len(episodes) % SAID_EVERY_N == 0:
                say(f"{len(episodes)} of {episodes_n} episodes are simulated")
    return episodes


def of_iteration(episodes: Sequence[Episode], iteration: int) -> list[Episode]:
    """The same episodes as those of an iteration, numbered on from the earlier ones."""
    first = iteration * len(episodes)
    return [
        replay.numbered(episode, {"iteration": iteration, "episode_id": first + place, "policy_version": iteration})
        for place, episode in enumerate(episodes)
    ]


def short(episodes: Sequence[Episode], rows_n: int) -> list[Episode]:
    """Their first rows, as whole episodes: runs that are many need not be large."""
    return [
        Episode(
            episode.frames.slice(0, rows_n).combine_chunks(),
            replay.numbered(Episode(episode.frames, episode.summary), {"steps": rows_n - 1}).summary,
        )
        for episode in episodes
    ]


def learned(iteration: int) -> Learned:
    """What an iteration leaves beside its episodes: its row and a policy of the usual size."""
    row = dict.fromkeys(schema.ITERATIONS.names, 0) | {"iteration": iteration, "policy_version": iteration}
    rng, widths = np.random.default_rng(iteration), (schema.OBSERVATION_N, 128, 128, 24)
    layers = tuple(
        (rng.normal(size=(outputs_n, inputs_n)).astype(np.float32), np.zeros(outputs_n, np.float32))
        for inputs_n, outputs_n in pairwise(widths)
    )
    versions = (0, 1) if iteration == 0 else (iteration + 1,)
    policies = [PolicySnapshot(version, layers, 0.9, 0.2) for version in versions]
    return Learned(row, [], schema.MODELS.empty_table(), policies)


def rows_n(episodes: Sequence[Episode]) -> int:
    """Rows of their frames."""
    return sum(episode.frames.num_rows for episode in episodes)


def raw_bytes(episodes: Sequence[Episode]) -> int:
    """What the numbers of their frames take in memory, each in its own type, without offsets and marks of nulls."""
    return rows_n(episodes) * sum(map(_width, schema.FRAMES))


def _width(field: pa.Field) -> int:
    length = vector_length(field)
    return int(field.type.bit_width // 8 if length is None else length * field.type.value_type.bit_width // 8)

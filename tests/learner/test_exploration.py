"""Laws of the covariance of the exploration noise: each episode has that of its own noise."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.exploration import Exploration, exploration
from t6gps.learner.learner import Learner
from t6gps.learner.report import kl
from t6gps.learner.rows import Rows
from t6gps.storage import schema

QUIET = 0.2


def quieted(table: pa.Table) -> pa.Table:
    """The episode with a fifth of its noise."""
    action, mean = schema.array(table, "action"), schema.array(table, "action_mean")
    column = pa.array([*(mean + np.float32(QUIET) * (action - mean)), None], type=schema.FRAMES.field("action").type)
    return table.set_column(schema.FRAMES.get_field_index("action"), schema.FRAMES.field("action"), column)


def mixed(rows: Rows) -> Rows:
    """Rows of which each second episode is quiet."""
    quiet = np.cumsum(~rows.acts) % 2 == 1
    action = rows.action_mean + np.where(quiet, np.float32(QUIET), np.float32(1))[:, None] * (
        rows.action - rows.action_mean
    )
    return replace(rows, action=action, noise_std_m=np.where(quiet, QUIET, 1).astype(np.float32) * rows.noise_std_m)


def test_each_level_of_noise_has_its_own_variance(rows: Rows) -> None:
    whole, several = exploration(rows, rows.acts), exploration(mixed(rows), rows.acts)
    assert len(whole.variance_m2) == 1 and not whole.level.any()
    quiet_m2, noisy_m2 = several.variance_m2
    assert noisy_m2 == pytest.approx(whole.variance_m2[0], rel=0.1)
    assert quiet_m2 == pytest.approx(QUIET**2 * noisy_m2, rel=0.1)
    assert np.array_equal(several.level == 0, mixed(rows).noise_std_m < rows.noise_std_m)


def test_a_level_without_a_sample_is_no_error(rows: Rows) -> None:
    unsampled = mixed(rows)
    assert exploration(unsampled, rows.acts & (unsampled.noise_std_m == rows.noise_std_m)).variance_m2[0] == 0.0


def test_the_divergence_counts_the_noise_of_the_episodes_own_policy(rows: Rows) -> None:
    part = np.flatnonzero(rows.acts)
    told = kl(rows, part, rows.action_mean[part] + 1, Exploration((0.04, 0.01), np.cumsum(~rows.acts) % 2))
    quiet = (np.cumsum(~rows.acts) % 2)[part] == 1
    assert told[quiet] == pytest.approx(24 / 2 / 0.01, rel=1e-4)
    assert told[~quiet] == pytest.approx(24 / 2 / 0.04, rel=1e-4)


def test_actions_of_a_quiet_episode_stay_nearer_to_its_policy(
    tables: list[pa.Table], rows: Rows, make_learner: Callable[..., Learner], iterate: Callable[..., None]
) -> None:
    """The KL term weighs c / s^2: with the pooled s^2 it would weigh too little there, and too much elsewhere."""
    planted = [quieted(table) if number % 2 else table for number, table in enumerate(tables)]
    quiet_ids = {table["episode_id"][0] for table in planted[1::2]}
    quiet = (np.cumsum(~rows.acts) % 2 == 1)[rows.continues]

    def moved(noise_std_m: Callable[[pa.Table], float]) -> tuple[float, float]:
        """Mean square of u* minus the policy's mean, in quiet and in noisy episodes (m2)."""
        learner = make_learner(kl_weight=0.5)
        iterate(learner, planted, noise_std_m)
        change = np.square(learner.state()[1]["replay_0_actions"] - rows.action_mean[rows.continues]).mean(axis=1)
        return change[quiet].mean(), change[~quiet].mean()

    told = moved(lambda table: 0.1 * QUIET if table["episode_id"][0] in quiet_ids else 0.1)
    pooled = moved(lambda _: 0.1)
    assert told[0] < pooled[0] / 4 and told[1] > 1.1 * pooled[1]

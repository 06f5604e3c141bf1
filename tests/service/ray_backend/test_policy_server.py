"""The policy server holds the newest policies, and whoever asks it waits for less time than an episode has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from t6gps.learner import policy
from t6gps.service.pool.attempt import policy_digest
from t6gps.service.pool.deadlines import TIMINGS
from t6gps.service.ray_backend.policy_server import VERSIONS_HELD_N, PolicyServerActor
from t6gps.service.ray_backend.worker_actor import VAIN_PULL_S
from t6gps.storage import schema
from t6gps.workers.robot.topology import CABLES_N

UNTRAINED = policy.initial(schema.OBSERVATION_N, CABLES_N, [8], np.random.default_rng(0), offset_m=1.0, scale_m=0.2)


def test_it_holds_the_newest_policies_and_no_others() -> None:
    server = PolicyServerActor()
    for version in range(VERSIONS_HELD_N + 1):
        server.hold(replace(UNTRAINED, version=version))
    for version in range(1, VERSIONS_HELD_N + 1):
        pulled = server.pull(version)
        assert pulled is not None
        assert policy_digest(pulled) == policy_digest(replace(UNTRAINED, version=version))
    assert server.pull(0) is None
    assert server.pull(VERSIONS_HELD_N + 1) is None


def test_an_episode_has_more_time_than_its_worker_needs_to_miss_the_server() -> None:
    assert TIMINGS.policy_answer_s + VAIN_PULL_S < TIMINGS.shortest_episode_s

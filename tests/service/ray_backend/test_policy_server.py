"""The policy server holds the newest policies, and whoever asks it waits for less time than an episode has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import ray
from house import joining

from t6gps.learner import policy
from t6gps.service.config import Config
from t6gps.service.logs import Speaker
from t6gps.service.pool.attempt import policy_digest
from t6gps.service.pool.deadlines import TIMINGS
from t6gps.service.ray_backend import cluster
from t6gps.service.ray_backend.policy_server import VERSIONS_HELD_N, PolicyServer, PolicyServerActor
from t6gps.service.ray_backend.worker_actor import VAIN_PULL_S
from t6gps.storage import schema
from t6gps.storage.errors import RunError
from t6gps.workers.robot.topology import CABLES_N

UNTRAINED = policy.initial(schema.OBSERVATION_N, CABLES_N, [8], np.random.default_rng(0), offset_m=1.0, scale_m=0.2)


def test_it_holds_the_newest_policies_and_no_others() -> None:
    server = PolicyServerActor(Speaker())
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


@pytest.mark.slow
def test_a_policy_server_that_dies_again_and_again_ends_the_run_with_the_cause(ray_head: dict[str, str]) -> None:
    def kill_for_ever() -> None:
        while True:
            ray.kill(server.source.actor)
            server.watch()

    with joining(ray_head), cluster.connection(Config()):
        server = PolicyServer(cluster.this_node(), TIMINGS)
        with pytest.raises(RunError, match=r"the policy server has failed 6 times.*has died: .*--resume"):
            kill_for_ever()


@pytest.mark.slow
def test_publishing_does_not_wait_for_the_server_which_has_the_policy_some_time_later(
    ray_head: dict[str, str],
) -> None:
    with joining(ray_head), cluster.connection(Config()):
        server = PolicyServer(cluster.this_node(), TIMINGS)
        server.publish(UNTRAINED)
        assert not server.has_the_newest(0.0)  # its process is starting
        assert server.has_the_newest(240.0)
        pulled = ray.get(server.source.actor.pull.remote(UNTRAINED.version))
        ray.kill(server.source.actor)
    assert policy_digest(pulled) == policy_digest(UNTRAINED)

"""The holder of the weights gives what it has, to whoever knows the secret, whatever else hangs on it."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from t6gps.learner import policy
from t6gps.service.pool import deadlines
from t6gps.service.pool.attempt import policy_digest
from t6gps.service.ray_backend import channel, policy_server
from t6gps.service.ray_backend.channel import Address
from t6gps.service.ray_backend.policy_server import ANSWER_DEADLINE_S, VERSIONS_HELD_N, HolderActor
from t6gps.service.ray_backend.transport import VAIN_PULL_S
from t6gps.storage import schema
from t6gps.workers.robot.topology import CABLES_N

UNTRAINED = policy.initial(schema.OBSERVATION_N, CABLES_N, [8], np.random.default_rng(0), offset_m=1.0, scale_m=0.2)


@pytest.fixture
def holder() -> Address:
    actor = HolderActor("127.0.0.1")
    address, _ = actor.whereabouts()
    threading.Thread(target=actor.hold, daemon=True).start()
    for version in range(VERSIONS_HELD_N + 1):
        policy_server._asked(address, replace(UNTRAINED, version=version))
    return address


def test_it_holds_the_newest_policies_and_no_others(holder: Address) -> None:
    for version in range(1, VERSIONS_HELD_N + 1):
        found = policy_server.pull(holder, version)
        assert found is not None
        assert policy_digest(found) == policy_digest(replace(UNTRAINED, version=version))
    assert policy_server.pull(holder, 0) is None
    assert policy_server.pull(holder, VERSIONS_HELD_N + 1) is None


def test_a_stranger_gets_nothing_and_changes_nothing(holder: Address) -> None:
    stranger = replace(holder, secret=bytes(32))
    with pytest.raises(policy_server.NO_ANSWER):
        policy_server.pull(stranger, 1)
    with pytest.raises(policy_server.NO_ANSWER):
        policy_server._asked(stranger, replace(UNTRAINED, version=9))
    assert policy_server.pull(holder, 9) is None


def test_nobody_waits_for_one_that_stalls(holder: Address) -> None:
    with channel.connect(holder), channel.connect(holder):  # they never ask
        assert policy_server.pull(holder, 1) is not None


def test_an_episode_has_more_time_than_its_worker_needs_to_miss_the_holder() -> None:
    assert ANSWER_DEADLINE_S + VAIN_PULL_S < deadlines.SHORTEST_S

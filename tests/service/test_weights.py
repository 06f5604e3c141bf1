"""The holder of the weights gives what it has, to whoever knows the secret, whatever else hangs on it."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from t6gps.learner import policy
from t6gps.service import channel, deadlines, weights
from t6gps.service.channel import Address
from t6gps.service.ray_transport import VAIN_PULL_S
from t6gps.service.sampler import policy_digest
from t6gps.service.weights import ANSWER_DEADLINE_S, VERSIONS_HELD_N, HolderActor
from t6gps.storage import schema
from t6gps.workers.topology import CABLES_N

UNTRAINED = policy.initial(schema.OBSERVATION_N, CABLES_N, [8], np.random.default_rng(0), offset_m=1.0, scale_m=0.2)


@pytest.fixture
def holder() -> Address:
    actor = HolderActor("127.0.0.1")
    address, _ = actor.whereabouts()
    threading.Thread(target=actor.hold, daemon=True).start()
    for version in range(VERSIONS_HELD_N + 1):
        weights._asked(address, replace(UNTRAINED, version=version))
    return address


def test_it_holds_the_newest_policies_and_no_others(holder: Address) -> None:
    for version in range(1, VERSIONS_HELD_N + 1):
        found = weights.pull(holder, version)
        assert found is not None
        assert policy_digest(found) == policy_digest(replace(UNTRAINED, version=version))
    assert weights.pull(holder, 0) is None
    assert weights.pull(holder, VERSIONS_HELD_N + 1) is None


def test_a_stranger_gets_nothing_and_changes_nothing(holder: Address) -> None:
    stranger = replace(holder, secret=bytes(32))
    with pytest.raises(weights.NO_ANSWER):
        weights.pull(stranger, 1)
    with pytest.raises(weights.NO_ANSWER):
        weights._asked(stranger, replace(UNTRAINED, version=9))
    assert weights.pull(holder, 9) is None


def test_nobody_waits_for_one_that_stalls(holder: Address) -> None:
    with channel.connect(holder), channel.connect(holder):  # they never ask
        assert weights.pull(holder, 1) is not None


def test_an_episode_has_more_time_than_its_worker_needs_to_miss_the_holder() -> None:
    assert ANSWER_DEADLINE_S + VAIN_PULL_S < deadlines.SHORTEST_S

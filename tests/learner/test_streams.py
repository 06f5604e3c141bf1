"""Laws of the random streams and of the phases: nothing comes twice, and the tables know every duration."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pyarrow as pa
import pytest

from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.learner.settings import ActionValueSettings, Localization
from t6gps.learner.streams import Stream, branch, generator
from t6gps.storage import schema


def test_no_two_streams_draw_the_same_numbers() -> None:
    assert len(set(map(int, Stream.__members__.values()))) == len(Stream.__members__)
    drawn = [generator(7, branch(iteration, stream)).random() for iteration in (0, 1) for stream in Stream]
    assert len(set(drawn)) == len(drawn)
    assert generator(7, branch(1, Stream.FITS, 2)).random() not in drawn


class Recorded(np.random.SeedSequence):
    """Counts the branches that generators are made of."""

    keys: ClassVar[Counter[tuple[int, ...]]] = Counter()

    def __init__(self, *arguments: Any, spawn_key: tuple[int, ...] = (), **others: Any) -> None:
        super().__init__(*arguments, spawn_key=spawn_key, **others)
        self.keys[spawn_key] += 1


@pytest.mark.parametrize("localization", [Localization.SEGMENTS, Localization.CLUSTERS])
def test_no_branch_is_drawn_from_twice_in_iterations_that_draw_from_all(
    tables: list[pa.Table],
    make_learner: Callable[..., Learner],
    iterate: Callable[..., None],
    monkeypatch: pytest.MonkeyPatch,
    localization: Localization,
) -> None:
    monkeypatch.setattr(np.random, "SeedSequence", Recorded)
    Recorded.keys.clear()
    value = ActionValueSettings(hidden_layers=(4,), batch=4, steps=1, first_steps=1)
    learner = make_learner(localization=localization, value_from=1, action_value=value)
    for _ in range(3):
        iterate(learner, tables)
    assert set(Recorded.keys.values()) == {1}
    drawn = {Stream(key[2]) for key in Recorded.keys}
    assert drawn == set(Stream) - ({Stream.CLUSTERS} if localization is Localization.SEGMENTS else set())


def test_every_phase_has_a_duration_in_the_tables_and_a_method() -> None:
    for phase in PHASES:
        assert schema.ITERATIONS.field(phase.duration_column).metadata[b"unit"] == b"s"
        assert callable(getattr(Learner, phase.name))
    assert len({phase.name for phase in PHASES}) == len({phase.title for phase in PHASES}) == len(PHASES)

"""Laws of the random streams and of the phases: nothing comes twice, and the tables know every duration."""

from __future__ import annotations

from t6gps.learner.learner import Learner
from t6gps.learner.phases import PHASES
from t6gps.learner.streams import Stream, branch, generator
from t6gps.storage import schema


def test_no_two_streams_draw_the_same_numbers() -> None:
    assert len(set(map(int, Stream.__members__.values()))) == len(Stream.__members__)
    drawn = [generator(7, branch(iteration, stream)).random() for iteration in (0, 1) for stream in Stream]
    assert len(set(drawn)) == len(drawn)
    assert generator(7, branch(1, Stream.FITS, 2)).random() not in drawn


def test_every_phase_has_a_duration_in_the_tables_and_a_method() -> None:
    for phase in PHASES:
        assert schema.ITERATIONS.field(phase.duration_column).metadata[b"unit"] == b"s"
        assert callable(getattr(Learner, phase.name))
    assert len({phase.name for phase in PHASES}) == len({phase.title for phase in PHASES}) == len(PHASES)

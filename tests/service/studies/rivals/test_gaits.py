"""Laws of gaits that evolution chooses: what they feel, and how evolution spends its steps."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from t6gps.service import config as configuration
from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.studies.rivals import evolution, gaits
from t6gps.service.studies.rivals.senses import Array
from t6gps.workers.episode.gaits import FLOP_PERIOD_STEPS, flop
from t6gps.workers.episode.rollout import controlled
from t6gps.workers.episode.running import RunningEpisode
from t6gps.workers.physics.bullet_engine import PyBulletEngine
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.robot.topology import NODES_M


@pytest.fixture(scope="module")
def config() -> Config:
    return configuration.load("rough", ["run.episodes=2"])


def commands(config: Config, parameters: Array, steps: int) -> tuple[Array, list[int], Array]:
    """Commands of the pattern in one episode [steps, 24], faces, and those of the gait by hand in the same states."""
    nominal_m = nominal_rest_length(config.robot)
    pattern, by_hand = gaits.pattern(nominal_m, parameters), flop(nominal_m)
    wanted, faces, others = [], [], []

    def control(episode: RunningEpisode, step: int) -> Array:
        faces.append(episode.frame.face)
        others.append(by_hand(episode, step))
        wanted.append(pattern(episode, step))
        return wanted[-1]

    plan = seeding.training_plans(config, 0)[0]
    with PyBulletEngine(config.robot) as engine:
        controlled(engine, config.rollout, plan, control, 0, nominal_m)
    return np.array(wanted)[:steps], faces[:steps], np.array(others)[:steps]


def test_the_pattern_begins_as_the_gait_by_hand(config: Config) -> None:
    wanted, faces, others = commands(config, gaits.by_hand(), FLOP_PERIOD_STEPS // 2)
    alike = [face == faces[0] for face in faces]
    assert sum(alike) > 3, "until the triangle changes"
    nominal_m = nominal_rest_length(config.robot)
    assert np.corrcoef(wanted[alike].ravel() - nominal_m, others[alike].ravel() - nominal_m)[0, 1] > 0.9


def standing(face: int) -> RunningEpisode:
    """The neutral robot on one of its triangles, as far as a pattern looks at it."""
    state = SimpleNamespace(nodes=lambda: NODES_M, com=np.zeros(3))
    frame = SimpleNamespace(face=face, kind=0, element=0)
    return SimpleNamespace(state=state, target=(0.6, 0.8), frame=frame)  # type: ignore[return-value]


def test_the_phase_begins_anew_on_each_triangle_and_in_each_episode() -> None:
    pattern = gaits.pattern(0.9, gaits.by_hand())
    first, second, third = (pattern(standing(face=3), step) for step in range(3))
    assert not np.allclose(first, second)
    assert not np.allclose(second, third)
    np.testing.assert_array_equal(pattern(standing(face=5), 3), first)
    np.testing.assert_array_equal(pattern(standing(face=5), 4), second)
    np.testing.assert_array_equal(pattern(standing(face=5), 0), first, "another episode")


def test_the_pattern_turns_at_the_frequency_of_its_triangles_kind() -> None:
    twice = gaits.by_hand()
    twice[-2] = 1.0  # Deltas; as a power of two
    slow, quick = (gaits.pattern(0.9, parameters) for parameters in (gaits.by_hand(), twice))
    slowly = [slow(standing(face=3), step) for step in range(2 * FLOP_PERIOD_STEPS + 1)]
    quickly = [quick(standing(face=3), step) for step in range(FLOP_PERIOD_STEPS + 1)]
    np.testing.assert_allclose(quickly, slowly[::2], atol=1e-12)
    np.testing.assert_allclose(slowly[FLOP_PERIOD_STEPS], slowly[0], atol=1e-12)


def test_a_reflex_of_zeros_is_the_nominal_length_and_none_goes_beyond_its_range() -> None:
    seen = np.random.default_rng(0).normal(size=83)
    for kind in (0, 1):
        episode: RunningEpisode = SimpleNamespace(observation=seen, frame=SimpleNamespace(kind=kind))  # type: ignore[assignment]
        np.testing.assert_array_equal(gaits.reflex(0.9, np.zeros(gaits.REFLEX_N))(episode, 0), np.full(24, 0.9))
        wild = gaits.reflex(0.9, np.random.default_rng(1).normal(size=gaits.REFLEX_N, scale=9))(episode, 0)
        assert (abs(wild - 0.9) <= gaits.REFLEX_SCALE_M + 1e-12).all()
        one = np.zeros((2, 24, 5))
        one[kind, 3, 1] = 1.0
        moved = gaits.reflex(0.9, one.ravel())(episode, 0)
        assert np.flatnonzero(moved != 0.9).tolist() == [3], "each kind has cables of its own"


def test_evolution_spends_whole_generations_within_each_mark_and_repeats_them(config: Config) -> None:
    reported: list[tuple[int, int]] = []
    generation = 14 * 100  # CMA-ES asks for 4 + 3 ln 32 offspring

    def means() -> list[tuple[int, float]]:
        nominal_m = nominal_rest_length(config.robot)
        plan = seeding.training_plans(config, 7)[0]
        with PyBulletEngine(config.robot) as engine:
            return [
                (
                    trained.steps,
                    controlled(engine, config.rollout, plan, trained.control, 0, nominal_m).summary["cost"][0].as_py(),
                )
                for trained in evolution.train(
                    gaits.pattern,
                    gaits.by_hand(),
                    0.2,
                    config,
                    (1000, 1500),
                    lambda done, of: reported.append((done, of)),
                )
            ]

    first = means()
    assert [steps for steps, _ in first] == [0, generation]
    assert len({cost for _, cost in first}) == 2
    assert reported == [(generation, 1500)]
    assert means() == first

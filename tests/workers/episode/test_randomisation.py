"""Laws of domain randomisation: within its spread, decided by the seed, recorded, and off by default."""

from dataclasses import replace

import numpy as np

from t6gps.storage import schema
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.workers.episode.randomisation import draw
from t6gps.workers.settings import RandomisationSettings, RobotSettings, RolloutSettings
from t6gps.workers.worker import RolloutWorker

WIDE = RandomisationSettings(
    mass_spread=0.2, stiffness_spread=0.3, friction_spread=0.4, winch_speed_spread=0.1, largest_delay_steps=2
)
PLAN = EpisodePlan(0, 0, 0, 11, 30, 5, 0.0, 0.1, 0)
NAMES = {
    "bar_mass_kg": 0.2,
    "cable_stiffness_n_per_m": 0.3,
    "friction": 0.4,
    "winch_speed_m_per_s": 0.1,
}


def still_policy() -> PolicySnapshot:
    layer = (np.zeros((24, schema.OBSERVATION_N), np.float32), np.zeros(24, np.float32))
    return PolicySnapshot(0, (layer,), 1.088, 0.2)


def test_draws_fill_their_spread_and_nothing_else_changes() -> None:
    robot, rng = RobotSettings(), np.random.default_rng(0)
    drawn, delays = zip(*(draw(robot, WIDE, rng) for _ in range(400)), strict=True)
    for name, spread in NAMES.items():
        factors = np.array([getattr(r, name) for r in drawn]) / getattr(robot, name)
        assert abs(factors - 1).max() <= spread
        assert np.ptp(factors) > 1.9 * spread
    assert set(delays) == {0, 1, 2}
    assert {r.model_copy(update={n: getattr(robot, n) for n in NAMES}) for r in drawn} == {robot}


def test_without_randomisation_the_robot_is_the_configured_one() -> None:
    robot = RobotSettings()
    assert draw(robot, RandomisationSettings(), np.random.default_rng(0)) == (robot, 0)


def test_an_episode_records_its_robot_and_depends_on_its_plan_alone() -> None:
    worker = RolloutWorker(RolloutSettings(randomisation=WIDE))
    first = worker.run(PLAN, still_policy())
    other = worker.run(replace(PLAN, seed=12), still_policy())
    again = worker.run(PLAN, still_policy())
    worker.close()
    assert first.frames.equals(again.frames)
    assert first.summary.equals(again.summary)
    for name in NAMES:
        assert first.summary[name][0] != other.summary[name][0]


def test_a_delayed_command_acts_that_many_steps_later() -> None:
    tracks = {}
    for delay in (0, 3):
        settings = RolloutSettings(randomisation=RandomisationSettings(largest_delay_steps=10))
        seed = next(
            s
            for s in range(200)
            if draw(
                settings.robot,
                settings.randomisation,
                np.random.default_rng(np.random.SeedSequence(s, spawn_key=(3,))),
            )[1]
            == delay
        )
        worker = RolloutWorker(settings)
        episode = worker.run(replace(PLAN, seed=seed, noise_std_m=0.0), still_policy())
        worker.close()
        assert episode.summary["delay_steps"][0].as_py() == delay
        tracks[delay] = np.abs(np.diff(schema.array(episode.frames, "rest_lengths"), axis=0)).max(axis=1)
    moving = {delay: int(np.flatnonzero(track > 1e-6)[0]) for delay, track in tracks.items()}
    assert moving == {0: 0, 3: 3}


def test_noisy_sensors_blur_what_the_policy_sees_and_nothing_else() -> None:
    episodes = []
    for noise in (0.0, 0.3):
        worker = RolloutWorker(RolloutSettings(randomisation=RandomisationSettings(sensor_noise=noise)))
        episodes.append(worker.run(PLAN, still_policy()))  # it commands the same whatever it sees
        worker.close()
    clear, blurred = (schema.array(episode.frames, "observation") for episode in episodes)
    errors = (blurred - clear)[:, 1:]
    assert np.array_equal(blurred[:, 0], clear[:, 0])
    assert 0.27 < errors.std() < 0.33 and abs(errors.mean()) < 0.03
    assert np.abs(np.corrcoef(errors[:-1].ravel(), errors[1:].ravel())[0, 1]) < 0.1
    assert episodes[0].frames.drop_columns("observation").equals(episodes[1].frames.drop_columns("observation"))


def test_biased_sensors_err_by_the_same_in_every_row_and_otherwise_in_every_episode() -> None:
    errors = []
    for seed in (11, 12):
        seen = []
        for bias in (0.0, 0.3):
            worker = RolloutWorker(RolloutSettings(randomisation=RandomisationSettings(sensor_bias=bias)))
            seen.append(worker.run(replace(PLAN, seed=seed), still_policy()).frames)
            worker.close()
        clear, wrong = (schema.array(frames, "observation") for frames in seen)
        assert seen[0].drop_columns("observation").equals(seen[1].drop_columns("observation"))
        error = wrong - clear
        np.testing.assert_allclose(error, np.broadcast_to(error[0], error.shape), atol=1e-6)
        assert not error[0, 0] and 0.2 < error[0, 1:].std() < 0.4
        errors.append(error[0])
    assert np.abs(np.corrcoef(*errors)[0, 1]) < 0.4

"""Laws of the random streams."""

from t6gps.learner.streams import Stream, branch
from t6gps.service.config import load
from t6gps.service.seeding import QUIET, Branch, evaluation_plans, sequence, training_plans
from t6gps.workers.episode import streams


def test_plans_depend_on_configuration_and_iteration_alone() -> None:
    a, b = load("flat-quick"), load("flat-quick", ["run.workers=9"])
    assert training_plans(a, 2) == training_plans(b, 2)


def test_a_pipelined_run_samples_with_the_policy_before_the_newest() -> None:
    for settings, versions in (([], [0, 1, 2, 3]), (["run.pipelined=true"], [0, 0, 1, 2])):
        config = load("flat-quick", settings)
        for iteration, version in enumerate(versions):
            assert {plan.policy_version for plan in training_plans(config, iteration)} == {version}


def test_no_two_episodes_share_a_seed_or_an_id() -> None:
    config = load("flat-quick")
    plans = [plan for iteration in range(5) for plan in training_plans(config, iteration)]
    unseen = evaluation_plans(config, 300, seed=config.run.seed, terrain_seed=None, version=5)
    seeds = [plan.seed for plan in plans + unseen] + [plan.terrain_seed for plan in plans + unseen]
    assert len(set(seeds)) == len(seeds)
    assert [plan.episode_id for plan in plans] == list(range(len(plans)))


def test_no_two_branches_of_a_run_or_of_an_episode_draw_the_same_numbers() -> None:
    of_run = {tuple(sequence(7, key).spawn_key) for key in Branch}
    assert len(of_run) == len(Branch.__members__)
    assert {branch(0, stream)[0] for stream in Stream} == {Branch.LEARNER}
    drawn = [streams.generator(7, stream).random() for stream in streams.Stream]
    assert len(set(drawn)) == len(drawn) == len(streams.Stream.__members__)


def test_a_smaller_iteration_is_the_beginning_of_a_larger_one() -> None:
    small, large = (load("flat-quick", [f"run.episodes={n}"]) for n in (5, 9))
    assert [p.seed for p in training_plans(small, 1)] == [p.seed for p in training_plans(large, 1)][:5]


def test_the_terrain_seed_of_an_evaluation_changes_the_ground_alone() -> None:
    config = load("rough-quick")
    a = evaluation_plans(config, 4, seed=1, terrain_seed=None, version=0)
    b = evaluation_plans(config, 4, seed=1, terrain_seed=2, version=0)
    assert [p.seed for p in a] == [p.seed for p in b]
    assert not {p.terrain_seed for p in a} & {p.terrain_seed for p in b}
    assert all(p.noise_std_m == 0 for p in a + b)


def test_episodes_that_the_action_value_leads_explore_within_the_reach_where_it_is_told() -> None:
    settings = ["learner.value_from=2", "robot.winch_speed_m_per_s=0.5", "exploration.noise_std_m=0.1"]
    for reach_noise, led in ((0.0, (0.1, False)), (1.5, (1.5 * 0.05, True))):
        config = load("flat-quick", [*settings, f"learner.action_value.reach_noise={reach_noise}"])
        explored = [{(p.noise_std_m, p.within_reach) for p in training_plans(config, i)} for i in range(4)]
        assert explored == [{(0.1, False)}, {(0.1, False)}, {led}, {led}]
        assert {(p.noise_std_m, p.within_reach) for p in evaluation_plans(config, 4, 0, None, 3)} == {(0.0, False)}


def test_quiet_episodes_are_spread_evenly_from_the_second_iteration_on() -> None:
    config = load("rough", ["run.episodes=40", "exploration.noise_std_m=0.1", "exploration.quiet_share=0.25"])
    assert {plan.noise_std_m for plan in training_plans(config, 0)} == {0.1}
    noises = [plan.noise_std_m for plan in training_plans(config, 1)]
    assert noises == [0.1, 0.1, 0.1, 0.1 * QUIET] * 10
    assert {plan.noise_std_m for plan in evaluation_plans(config, 8, 0, None, 1)} == {0.0}

"""Laws of the Gymnasium environment: the same episode as the rollout's, through the interface that everyone knows."""

import copy
import pickle
import re
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray

from t6gps.storage import schema
from t6gps.storage.errors import ConfigError, DataError, PhysicsError
from t6gps.storage.records import EpisodePlan, PolicySnapshot
from t6gps.workers.environment import ENVIRONMENT_ID, EPISODE_STEPS, SuperBallEnvironment
from t6gps.workers.robot.neutral import nominal_rest_length
from t6gps.workers.settings import RobotSettings, RolloutSettings, TaskSettings, TerrainSettings
from t6gps.workers.worker import RolloutWorker

PAGE = Path(__file__).parents[2] / "docs" / "environment.md"
BY_MODULE = f"t6gps.workers.environment:{ENVIRONMENT_ID}"
Floats = NDArray[np.float32]


@pytest.fixture(scope="module")
def environment() -> Iterator[SuperBallEnvironment]:
    environment = SuperBallEnvironment()
    yield environment
    environment.close()


def actions(steps: int, seed: int = 0) -> Floats:
    return np.random.default_rng(seed).uniform(-1, 1, (steps, 24)).astype(np.float32)


def trajectory(environment: SuperBallEnvironment, seed: int, steps: int = 20) -> tuple[Floats, NDArray[np.float64]]:
    """Observations [steps + 1, 47] and rewards [steps] under the same random actions."""
    observations, rewards = [environment.reset(seed=seed)[0]], []
    for action in actions(steps):
        observation, reward, *_ = environment.step(action)
        observations.append(observation)
        rewards.append(reward)
    return np.stack(observations), np.array(rewards)


def test_gymnasiums_own_check_passes_without_a_warning() -> None:
    made = gymnasium.make(BY_MODULE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(made.unwrapped)
    made.close()


def test_a_name_with_its_module_needs_no_import() -> None:
    program = f"import gymnasium; print(gymnasium.make({BY_MODULE!r}).spec.max_episode_steps)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == (f"{EPISODE_STEPS}\n", "")


def test_without_gymnasium_one_error_names_the_remedy_and_the_rest_works() -> None:
    program = """
import sys
sys.modules["gymnasium"] = None
import t6gps.workers.worker
try:
    import t6gps.workers.environment
except ModuleNotFoundError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "pip install 't6gps[gym]'" in done.stdout


@pytest.mark.parametrize("difficulty", [0.0, 1.0])
def test_the_actions_of_a_rollout_repeat_it_to_the_last_bit(difficulty: float) -> None:
    rng = np.random.default_rng(1)
    layers = ((0.3 * rng.standard_normal((24, 47)).astype(np.float32), np.zeros(24, np.float32)),)
    plan = EpisodePlan(0, 0, 0, 5, 60, terrain_seed=3, terrain_difficulty=difficulty, noise_std_m=0.0, policy_version=0)
    worker = RolloutWorker(RolloutSettings())
    episode = worker.run(plan, PolicySnapshot(0, layers, offset_m=nominal_rest_length(RobotSettings()), scale_m=0.2))
    worker.close()
    frames = episode.frames
    recorded = schema.array(frames, "action").astype(np.float64)
    robot = RobotSettings()
    scaled = 2 * (recorded - robot.shortest_command_m) / (robot.longest_command_m - robot.shortest_command_m) - 1
    assert np.ptp(scaled) == pytest.approx(2)  # both ends of the range occur

    environment = SuperBallEnvironment(terrain=TerrainSettings(difficulty=difficulty))
    observation, info = environment.reset(seed=plan.seed, options={"terrain_seed": plan.terrain_seed})
    observations, rewards, infos = [observation], [], [info]
    for action in scaled.astype(np.float32):
        observation, reward, terminated, truncated, info = environment.step(action)
        assert not terminated
        assert not truncated
        observations.append(observation)
        rewards.append(reward)
        infos.append(info)
    environment.close()

    assert np.array_equal(np.stack(observations), schema.array(frames, "observation"))
    columns = {name: schema.array(frames, name) for name in ("cost", "forward_speed_m_per_s", "face", "com_x_m")}
    assert np.allclose(rewards, -columns["cost"][1:], rtol=1e-12)
    assert np.allclose([i["forward_speed_m_per_s"] for i in infos], columns["forward_speed_m_per_s"], atol=1e-12)
    assert [i["face"] for i in infos] == columns["face"].tolist()
    assert [i["com_m"][0] for i in infos] == columns["com_x_m"].tolist()
    assert infos[-1]["waypoints_reached"] == episode.summary["waypoints_reached"][0].as_py()


def test_a_seed_decides_start_course_and_ground() -> None:
    environment = SuperBallEnvironment(terrain=TerrainSettings(difficulty=1.0))
    first, rewards = trajectory(environment, seed=4)
    environment.reset(seed=5)
    again, same_rewards = trajectory(environment, seed=4)
    assert np.array_equal(first, again)
    assert np.array_equal(rewards, same_rewards)
    assert not np.array_equal(first[0], trajectory(environment, seed=6, steps=1)[0][0])
    for ground in (4, 5):
        start, _ = environment.reset(seed=4, options={"terrain_seed": ground})
        assert np.array_equal(first[0], start) == (ground == 4)
    environment.close()


def test_a_drawn_episode_can_be_repeated_from_the_seeds_in_its_info(environment: SuperBallEnvironment) -> None:
    environment.reset(seed=1)
    drawn, info = environment.reset()
    assert info["seed"] != 1
    again, _ = environment.reset(seed=info["seed"], options={"terrain_seed": info["terrain_seed"]})
    assert np.array_equal(drawn, again)


@pytest.mark.parametrize("robot", [RobotSettings(), RobotSettings(winch_speed_m_per_s=2.0, shortest_command_m=0.4)])
def test_no_observation_leaves_the_box_and_rest_lengths_reach_its_sides(robot: RobotSettings) -> None:
    environment = SuperBallEnvironment(robot)
    box = environment.observation_space
    assert box.is_bounded()
    seen = [environment.reset(seed=2)[0]]
    for extreme in (-1.0, 1.0):
        seen += [environment.step(np.full(24, extreme, np.float32))[0] for _ in range(35)]
    seen += [environment.step(np.sign(action))[0] for action in actions(50)]
    environment.close()
    assert all(observation in box for observation in seen)
    assert np.allclose(np.min(seen, axis=0)[1:25], box.low[1:25])
    assert np.allclose(np.max(seen, axis=0)[1:25], box.high[1:25])


def test_actions_beyond_the_box_act_as_its_sides(environment: SuperBallEnvironment) -> None:
    ends = []
    for size in (1.0, 7.0):
        environment.reset(seed=3)
        ends.append(environment.step(np.full(24, size, np.float32))[0])
    assert np.array_equal(*ends)


def test_an_episode_is_truncated_after_t_steps_and_not_before() -> None:
    made = gymnasium.make(ENVIRONMENT_ID)
    made.reset(seed=0)
    flags = [made.step(np.zeros(24, np.float32))[2:4] for _ in range(EPISODE_STEPS)]
    made.close()
    assert flags == [(False, False)] * (EPISODE_STEPS - 1) + [(False, True)]


def test_leaving_the_sound_states_terminates_says_why_and_never_pays() -> None:
    """A robot of coarse physics steps whose bars spin freely stands, but does not bear fast winches."""
    fragile = RobotSettings(
        physics_step_s=0.01,
        axial_inertia_kg_m2=0.01,
        axial_damping_n_m_s=0.0,
        cable_max_tension_n=10000.0,
        winch_speed_m_per_s=2.0,
        shortest_command_m=0.4,
    )
    environment = SuperBallEnvironment(fragile, TaskSettings(target_speed_m_per_s=0.5))
    observation, _ = environment.reset(seed=0)
    jerks = np.sign(actions(100))
    for action in jerks:
        before = observation
        observation, reward, terminated, truncated, info = environment.step(action)
        if terminated:
            break
    assert (terminated, truncated) == (True, False)
    assert "unstable" in info["ended_by"]
    assert np.array_equal(observation, before)
    assert reward == -EPISODE_STEPS * 0.5**2
    with pytest.raises(gymnasium.error.ResetNeeded, match="reset"):
        environment.step(np.zeros(24, np.float32))
    environment.reset(seed=0)
    assert "ended_by" not in environment.step(np.zeros(24, np.float32))[4]
    environment.close()


@pytest.mark.parametrize("action", [np.zeros(23, np.float32), np.full(24, np.nan, np.float32)])
def test_an_action_that_is_not_24_finite_numbers_is_refused(environment: SuperBallEnvironment, action: Floats) -> None:
    environment.reset(seed=0)
    with pytest.raises(DataError, match="24 finite numbers"):
        environment.step(action)


def test_unknown_options_and_difficulties_are_refused(environment: SuperBallEnvironment) -> None:
    with pytest.raises(DataError, match="terrain_seed, found ground"):
        environment.reset(options={"ground": 3})
    with pytest.raises(ValueError, match=r"less than or equal to 1\.5"):
        SuperBallEnvironment(terrain=TerrainSettings(difficulty=1.6))


@pytest.mark.parametrize("value", [1.9, -1, True, np.True_, "3", [1]])
@pytest.mark.parametrize("name", ["seed", "terrain_seed"])
def test_a_seed_is_a_whole_number_or_refused(environment: SuperBallEnvironment, name: str, value: Any) -> None:
    with pytest.raises(DataError, match=f"{name} must be a whole number from 0 on, found") as error:
        environment.reset(seed=value) if name == "seed" else environment.reset(options={name: value})
    assert repr(value) in str(error.value)


def test_seeds_of_numpy_are_those_of_python(environment: SuperBallEnvironment) -> None:
    _, info = environment.reset(seed=np.int64(3), options={"terrain_seed": np.uint8(4)})  # type: ignore[arg-type]
    assert (info["seed"], info["terrain_seed"]) == (3, 4)
    with pytest.raises(DataError, match="are a mapping"):
        environment.reset(options=[4])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("copied", "wrapped"),
    [(copy.copy, False), (copy.deepcopy, False), (copy.deepcopy, True), (pickle.dumps, False), (pickle.dumps, True)],
)
def test_an_environment_cannot_be_copied(copied: Callable[[object], object], wrapped: bool) -> None:
    """A copy would move the robot of the original, and closing one would close the other."""
    made = gymnasium.make(ENVIRONMENT_ID)
    twin = gymnasium.make(ENVIRONMENT_ID)
    observation, _ = made.reset(seed=3)
    with pytest.raises(PhysicsError, match="SuperBallEnvironment cannot be copied or pickled"):
        copied(made if wrapped else made.unwrapped)
    twin.reset(seed=3)
    action = np.zeros(24, np.float32)
    assert np.array_equal(made.step(action)[0], twin.step(action)[0])
    assert not np.array_equal(observation, made.step(action)[0])
    made.close()
    twin.close()


def test_a_closed_environment_says_so() -> None:
    environment = SuperBallEnvironment()
    environment.reset(seed=0)
    environment.close()
    environment.close()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="closed; make another one"):
        environment.reset()
    with pytest.raises(gymnasium.error.ClosedEnvironmentError, match="closed; make another one"):
        environment.step(np.zeros(24, np.float32))


def test_plain_settings_pass_through_json_and_make_the_same_environment() -> None:
    settings = {"robot": {"friction": 0.7}, "task": {"waypoints": 3}, "terrain": {"difficulty": 0.5}}
    made = gymnasium.make(ENVIRONMENT_ID, **settings)  # type: ignore[arg-type]
    assert made.spec is not None
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(made.spec.to_json()))
    groups = SuperBallEnvironment(
        RobotSettings(friction=0.7), TaskSettings(waypoints=3), TerrainSettings(difficulty=0.5)
    )
    rows = [trajectory(environment, 5)[0] for environment in (made.unwrapped, again.unwrapped, groups)]
    assert np.array_equal(rows[0], rows[1])
    assert np.array_equal(rows[0], rows[2])
    for environment in (made, again, groups):
        environment.close()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"terrain": {"rough": 1}}, "unknown key terrain.rough; allowed in terrain: difficulty, tilt_deg"),
        ({"terrain": {"difficulty": 3}}, "terrain.difficulty: must be less than or equal to 1.5, found 3"),
        ({"robot": {"friction": np.ones(2)}}, "robot: Object of type ndarray is not JSON serializable; use plain"),
        ({"task": 3}, "task must be TaskSettings or a mapping, found 3"),
        ({"terrain": RobotSettings()}, "terrain must be TerrainSettings or a mapping, found RobotSettings"),
        ({"terrain": {"difficulty": 1.0}, "task": {"directions": 3}}, "starts from rest on flat ground"),
    ],
)
def test_settings_that_are_none_are_refused_with_what_is_allowed(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        SuperBallEnvironment(**settings)


@pytest.mark.slow
@pytest.mark.parametrize("context", ["fork", "spawn"])
def test_environments_in_processes_do_what_single_ones_do(environment: SuperBallEnvironment, context: str) -> None:
    # By module, since a spawned process starts without this one's imports.
    vector = gymnasium.make_vec(BY_MODULE, 2, vectorization_mode="async", vector_kwargs={"context": context})
    rows: list[Any] = [vector.reset(seed=[7, 8])[0]]
    rows += [vector.step(np.stack([action, action]))[0] for action in actions(20)]
    vector.close()
    for index, seed in enumerate((7, 8)):
        assert np.array_equal(np.stack(rows)[:, index], trajectory(environment, seed)[0])


def test_the_examples_of_the_page_run_as_they_stand(capsys: pytest.CaptureFixture[str]) -> None:
    examples = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert len(examples) == 3
    for example in examples:
        exec(compile(example, str(PAGE), "exec"), {"__name__": "__example__"})
    assert "return" in capsys.readouterr().out

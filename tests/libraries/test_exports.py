"""Exports are opened by the libraries they are for: RLlib's own reader, and LeRobot in an environment of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import gymnasium
import numpy as np
import pyarrow.parquet as pq
import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.storage import schema, tables

LEROBOT = Path(__file__).with_name("lerobot_reader.py")
WHEELS = (
    "lerobot==0.4.4",
    "accelerate==1.15.0",
    "av==15.1.0",
    "datasets==4.8.4",
    "dill==0.4.1",
    "huggingface_hub==0.35.3",
    "multiprocess==0.70.19",
    "safetensors==0.6.2",
    "torchvision==0.28.0",
    "tqdm==4.70.1",
    "xxhash==4.1.0",
)
"""What LeRobot's datasets import beside what is installed here: LeRobot itself asks for an older torch."""


@pytest.mark.slow
def test_rllib_reads_every_transition(tiny: Trained, tmp_path: Path) -> None:
    from ray.rllib.algorithms.bc import BCConfig  # noqa: PLC0415 - seconds, which collecting tests should not take
    from ray.rllib.offline.offline_prelearner import OfflinePreLearner  # noqa: PLC0415

    out = tmp_path / "rolling"
    t6gps("export", "rllib", out, "--root", tiny.run.path.parent)
    rows = pq.read_table(out / "data")
    batch = {name: np.array(rows.column(name).to_pylist()) for name in rows.column_names}
    spaces = tuple(gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32) for n in (schema.OBSERVATION_N, 24))
    config = BCConfig().environment(observation_space=spaces[0], action_space=spaces[1])  # type: ignore[no-untyped-call]
    module = config.get_multi_rl_module_spec(spaces={"__env__": spaces, "default_policy": spaces})
    reader = OfflinePreLearner(config=config.rl_module(rl_module_spec=module), spaces=spaces)
    found = {key.removeprefix("default_policy/"): np.asarray(value) for key, value in reader(batch).items()}
    frames = tables.read(tiny.run, "frames").to_pandas()
    steps = frames[frames["action"].notna()]
    after = frames[frames["step"] > 0]
    assert np.array_equal(found["obs"], np.stack(steps["observation"]))
    assert np.array_equal(found["actions"], np.stack(steps["action"]))
    assert np.array_equal(found["new_obs"], np.stack(after["observation"]))
    assert np.array_equal(found["rewards"], -after["cost"].to_numpy(np.float32))
    assert not found["terminateds"].any()
    assert found["truncateds"].sum() == 9


@pytest.fixture(scope="module")
def libraries(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with LeRobot and what its datasets import."""
    folder = tmp_path_factory.mktemp("lerobot")
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-deps",
        "--retries=1",
        "--timeout=30",
        "--target",
        folder,
    ]
    done = subprocess.run([*map(str, command), *WHEELS], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"LeRobot cannot be had here: {done.stderr.strip().splitlines()[-1]}")
    return folder


@pytest.mark.slow
def test_lerobot_opens_filters_merges_and_loses_the_last_state_alone(
    tiny: Trained, libraries: Path, tmp_path: Path
) -> None:
    out = tmp_path / "rolling"
    t6gps("export", "lerobot", out, "--root", tiny.run.path.parent)
    variables = {"HF_HUB_OFFLINE": "1", "HF_HOME": str(tmp_path / "home"), "PYTHONPATH": str(libraries)}
    command = [sys.executable, str(LEROBOT), str(out), str(tmp_path / "rows.npz")]
    done = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    frames = tables.read(tiny.run, "frames").to_pandas()
    steps, after = frames[frames["action"].notna()], frames[frames["step"] > 0]
    with np.load(tmp_path / "rows.npz") as rows:
        assert np.array_equal(rows["observation.state"], np.stack(steps["observation"]))
        assert np.array_equal(rows["action"], np.stack(steps["action"]))
        assert np.array_equal(rows["next.reward"], -after["cost"].to_numpy(np.float32))
        assert np.array_equal(rows["timestamp"], steps["time_s"].to_numpy(np.float32))
        assert np.array_equal(rows["frame_index"], steps["step"].to_numpy())
        assert rows["next.done"].sum() == 9
    assert json.loads(done.stdout.splitlines()[-1]) == {
        "episodes": 9,
        "fps": 10,
        "robot": "superball",
        "task": "Roll towards the waypoint.",
        "of two": 2,
        "without one": 8,
        "merged": 17,
    }

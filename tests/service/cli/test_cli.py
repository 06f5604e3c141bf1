"""Laws of the command line: results on stdout, one clear sentence and exit code 2 for bad input, nothing written."""

import csv
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import tiny_run
from command import started, t6gps
from run_digest import digests
from tiny_run import Trained

from t6gps.service import config as configuration
from t6gps.storage import catalog, tables
from t6gps.storage.sql import query
from t6gps.workers.episode import policy as acting
from t6gps.workers.locomotion.measures import measures

TINY = tiny_run.settings()
SLOW = {"fastapi", "matplotlib", "minari", "obstore", "ray", "rerun", "sklearn", "torch"}
"""Modules that take a while to load."""


def test_the_command_line_loads_nothing_slow_before_it_knows_the_command() -> None:
    script = "import sys, t6gps.service.cli.main; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert not SLOW & set(loaded.stdout.split())


@pytest.fixture(scope="module")
def root(tiny: Trained) -> Path:
    """A root with one finished run named `tiny`."""
    return tiny.run.path.parent


def test_train_prints_the_learning_curve_the_files_and_what_to_try_next(tiny: Trained) -> None:
    for word in ("forward m/s", "dataset", "checkpoints", "learning.png", "Try next", "t6gps eval tiny"):
        assert word in tiny.printed


def test_a_finished_run_has_data_checkpoints_and_figures(tiny: Trained) -> None:
    run = tiny.run
    assert tables.committed_iterations(run) == 3
    assert tables.read(run, "frames").num_rows == 3 * 3 * 31
    assert len(list(run.checkpoints.glob("iteration-*"))) == 3
    assert {path.name for path in run.figures.glob("*.png")} >= {"learning.png", "ground_track.png", "segments.png"}


def test_eval_prints_the_named_keys_as_json(root: Path) -> None:
    arguments = ("eval", "tiny", "--episodes", "2", "--serial", "--no-keep", "--json")
    result = json.loads(t6gps(*arguments, "--root", root).stdout)
    for key in (
        "forward_speed_m_per_s",
        "stuck_share_by_distance",
        "stuck_share_by_speed",
        "waypoints_per_episode",
        "cost",
        "speed_over_winch_speed",
        "bar_lengths_per_s",
        "cost_of_transport",
        "slip_per_metre",
        "sunk_cable_share",
    ):
        assert set(result[key]) == {"mean", "standard_error"}
    speed = result["forward_speed_m_per_s"]["mean"]
    assert result["bar_lengths_per_s"]["mean"] == pytest.approx(speed / 1.94)
    assert result["speed_over_winch_speed"]["mean"] == pytest.approx(speed / 0.35)
    assert result["cost_of_transport"]["mean"] > 0


def test_eval_changes_the_world_but_not_the_policy(root: Path) -> None:
    arguments = ("eval", "tiny", "--episodes", "2", "--serial", "--no-keep", "--json")
    usual = json.loads(t6gps(*arguments, "--root", root).stdout)
    for change in ("terrain.difficulty=0.5", "randomisation.sensor_noise=0.3"):
        changed = json.loads(t6gps(*arguments, "--set", change, "--root", root).stdout)
        assert usual["cost"] != changed["cost"]
    refused = t6gps(*arguments, "--set", "learner.kl_weight=1", "--root", root, code=2)
    assert "eval cannot change learner.kl_weight" in refused.stderr


def test_eval_keeps_the_episodes_of_any_policy_in_any_world(tiny: Trained, tmp_path: Path) -> None:
    run = catalog.copy(tiny.run, tmp_path, "copy")
    arguments = ("eval", "copy", "--episodes", "2", "--seed", "5", "--serial", "--json", "--root", tmp_path)
    changed = ("--set", "terrain.difficulty=0.5", "--policy", "1")
    done = t6gps(*arguments, *changed)
    assert "kept as evaluation 1" in done.stderr
    row = tables.read(run, "evaluations").to_pylist()[-1]
    assert json.loads(row["settings"]) == {"terrain.difficulty": 0.5}
    assert (row["purpose"], row["policy_version"], row["seed"]) == ("eval", 1, 5)
    result = json.loads(done.stdout)
    sql = "SELECT avg(cost) AS cost FROM evaluation_episodes WHERE evaluation_id = 1"
    assert query.query(query.Question([run], sql)).to_pylist() == [{"cost": pytest.approx(result["cost"]["mean"])}]
    frames = tables.episode(run, 1, 1).frames
    assert set(frames["policy_version"].to_pylist()) == {1}
    world = configuration.kept(run, ["terrain.difficulty=0.5"]).rollout
    of_episodes = [asdict(measures(tables.episode(run, number, 1), world)) for number in (0, 1)]
    for name in of_episodes[0]:
        assert row[name] == result[name]["mean"] == pytest.approx(np.mean([found[name] for found in of_episodes]))
    assert frames["ground_slope_deg"].to_numpy().max() > 0
    t6gps("render", "copy", "1", "--evaluation", "1", "--out", tmp_path / "still.png", "--root", tmp_path)
    assert "keeps no evaluation 7; kept: 0, 1" in t6gps(
        "render", "copy", "1", "--evaluation", "7", "--out", "still.png", "--root", tmp_path, code=2
    ).stderr  # fmt: skip
    before = tables.read(run, "evaluations").num_rows
    t6gps(*arguments, "--no-keep")
    assert tables.read(run, "evaluations").num_rows == before
    refused = t6gps(*arguments, "--policy", "9", code=2)
    assert "keeps no policy of version 9; kept: 0, 1, 2, 3" in refused.stderr


def test_a_policy_of_before_commands_what_it_sampled_with(tiny: Trained) -> None:
    """The actions that iterations recorded are those of their versions in the table."""
    commands_m = tiny.config.robot.shortest_command_m, tiny.config.robot.longest_command_m
    for version in range(3):
        frames = tables.read(tiny.run, "frames", filter=pc.field("policy_version") == version)
        act = acting.ready(tables.policy(tiny.run, version))
        rows = [row for row in frames.select(["observation", "action_mean"]).to_pylist() if row["action_mean"]]
        seen = np.array([row["observation"] for row in rows], np.float32)
        commands = np.clip([act(observation) for observation in seen], *commands_m)
        np.testing.assert_allclose(commands, [row["action_mean"] for row in rows], atol=1e-6)


def test_query_gives_the_same_rows_in_every_format(root: Path) -> None:
    def answer(form: str) -> bytes:
        sql = "SELECT episode_id, cost FROM episodes ORDER BY episode_id"
        return t6gps("query", "tiny", sql, "--format", form, "--root", root).stdout

    rows = json.loads(answer("json"))
    assert [row["episode_id"] for row in rows] == list(range(9))
    assert pa.ipc.open_stream(answer("arrow")).read_all().to_pylist() == rows
    read = list(csv.DictReader(io.StringIO(answer("csv").decode())))
    assert [(int(row["episode_id"]), float(row["cost"])) for row in read] == [tuple(row.values()) for row in rows]
    assert "episode_id" in answer("table").decode()


def test_runs_and_show_describe_the_run(root: Path) -> None:
    assert "3 of 3" in t6gps("runs", "--root", root).stdout.decode()
    printed = t6gps("show", "tiny", "--root", root).stdout.decode()
    for word in ("Segment classes", "Lambda", "Diagnosis:", "Noise-free policy", "dataset"):
        assert word in printed


def test_render_writes_a_still(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "episode.png"
    t6gps("render", "tiny", "1", "--out", out, "--root", root)
    assert out.read_bytes().startswith(b"\x89PNG")


def test_resuming_a_finished_run_keeps_it(tiny: Trained, root: Path) -> None:
    t6gps("train", "flat-quick", "--run", "tiny", "--serial", "--resume", *TINY, "--root", root)
    assert digests(tiny.run.path) == tiny.digests


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["train", "flat-quik"], ["unknown preset 'flat-quik'", "did you mean flat-quick"]),
        (["train", "flat-quick", "--set", "run.sed=1"], ["unknown key run.sed", "run.seed"]),
        (["train", "flat-quick", "--set", "run.seed=x"], ["run.seed", "'x'"]),
        (["train", "flat-quick", "--workers", "0"], ["run.workers", "greater than or equal to 1"]),
        (["train", "flat-quick", "--run", "../elsewhere"], ["letters, digits", "../elsewhere"]),
        (["train", "flat-quick", "--run", "tiny"], ["exists already", "--resume"]),
        (["train", "flat-quick", "--run", "tiny", "--resume", *TINY, "--set=learner.epochs=3"],
         ["learner.epochs = 3", "the run has 2"]),
        (["train", "flat-quick", "--set", "robot.bar_mass_kg=20"], ["stance collapses", "robot.pretension_n"]),
        (["train", "flat-quick", "--set", "terrain.file=none.stl"], ["no file", "none.stl"]),
        (["train", "flat-quick", "--autoscale", "3"], ["--autoscale takes MIN:MAX", "3"]),
        (["train", "flat-quick", "--autoscale", "3:2"], ["workers_min must not exceed workers_max"]),
        (["scale", "tinny", "2"], ["no run 'tinny'", "did you mean 'tiny'"]),
        (["scale", "tiny", "2"], ["no status", "never run with workers"]),
        (["status", "tiny"], ["no status", "never run with workers"]),
        (["eval", "tinny"], ["no run 'tinny'", "did you mean 'tiny'"]),
        (["show", "a/b"], ["letters, digits"]),
        (["query", "tiny", "SELEC 1"], ["SELEC"]),
        (["query", "tiny", "SELECT speed FROM episodes"], ["speed"]),
        (["query", "tiny", "COPY episodes TO 'x.csv'"], ["SELECT"]),
        (["render", "tiny", "99", "--out", "x.png"], ["99", "8"]),
        (["render", "tiny", "0", "--out", "x.gif"], [".png", ".mp4"]),
        (["study", "horizont"], ["unknown study 'horizont'", "did you mean horizon"]),
        (["study", "horizon", "--set=run.steps=15", "--set=run.episodes=60"],
         ["learner.horizon_steps = 20", "longer than an episode"]),
        (["bench", "phisics"], ["unknown benchmark 'phisics'", "physics"]),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_clear_sentence(root: Path, arguments: list[str], words: list[str]) -> None:
    before = sorted(root.rglob("*"))
    refused = t6gps(*arguments, "--root", root, code=2)
    message = refused.stderr
    assert refused.stdout == b""
    assert message.startswith("error: ")
    assert "Traceback" not in message
    for word in words:
        assert word in message
    assert sorted(root.rglob("*")) == before


def test_a_root_that_cannot_hold_runs_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    refused = t6gps("train", "flat-quick", "--root", file / "runs", code=2)
    assert "needed: a writable folder" in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    ("executor", "stop"),
    [
        (["--serial"], signal.SIGINT),
        (["--serial"], signal.SIGTERM),
        pytest.param(["--workers", "1"], signal.SIGINT, marks=pytest.mark.ray),
    ],  # SIGTERM with workers: tests/service/ray_backend/test_processes.py
)
def test_a_stopped_run_ends_within_seconds_and_resumes(
    tmp_path: Path, wait_until: Callable[..., None], executor: list[str], stop: signal.Signals
) -> None:
    settings = [*TINY, "--set=run.steps=250", "--set=run.episodes=40", "--set=run.iterations=1"]
    arguments = ["train", "flat-quick", "--run", "stopped", "--root", str(tmp_path), *settings]
    process = started(*arguments, *executor)
    spooled = "stopped/spool/iteration-*/episode-*.arrow"
    try:
        wait_until(lambda: process.poll() is not None or len(list(tmp_path.glob(spooled))) >= 2, 240)
        assert process.poll() is None
        os.kill(process.pid, stop)
        _, message = process.communicate(timeout=240)  # it takes a second or two where nothing else runs
    finally:
        process.kill()
    assert process.returncode == 130
    assert b"--resume" in message
    assert b"Traceback" not in message
    kept = len(list(tmp_path.glob(spooled)))
    assert 2 <= kept < 40
    t6gps(*arguments, "--serial", "--resume")
    assert tables.read(catalog.open_run(tmp_path, "stopped"), "episodes").num_rows == 40

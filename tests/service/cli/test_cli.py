"""Laws of the command line: results on stdout, one clear sentence and exit code 2 for bad input, nothing written."""

import csv
import io
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest
import tiny_run
from command import started, t6gps
from run_digest import digests
from tiny_run import Trained

from t6gps.storage import catalog, tables

TINY = tiny_run.settings()


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
    result = json.loads(t6gps("eval", "tiny", "--episodes", "2", "--serial", "--json", "--root", root).stdout)
    for key in (
        "forward_speed_m_per_s",
        "stuck_share_by_distance",
        "stuck_share_by_speed",
        "waypoints_per_episode",
        "cost",
    ):
        assert set(result[key]) == {"mean", "standard_error"}


def test_eval_changes_the_world_but_not_the_policy(root: Path) -> None:
    arguments = ("eval", "tiny", "--episodes", "2", "--serial", "--json")
    usual = json.loads(t6gps(*arguments, "--root", root).stdout)
    for change in ("terrain.difficulty=0.5", "randomisation.sensor_noise=0.3"):
        changed = json.loads(t6gps(*arguments, "--set", change, "--root", root).stdout)
        assert usual["cost"] != changed["cost"]
    refused = t6gps(*arguments, "--set", "learner.kl_weight=1", "--root", root, code=2)
    assert "eval cannot change learner.kl_weight" in refused.stderr


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
        (["train", "flat-quick", "--run", "none", "--resume"], ["no run 'none'", "tiny"]),
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
        _, message = process.communicate(timeout=60)  # it takes a second or two where nothing else runs
    finally:
        process.kill()
    assert process.returncode == 130
    assert b"--resume" in message
    assert b"Traceback" not in message
    kept = len(list(tmp_path.glob(spooled)))
    assert 2 <= kept < 40
    t6gps(*arguments, "--serial", "--resume")
    assert tables.read(catalog.open_run(tmp_path, "stopped"), "episodes").num_rows == 40

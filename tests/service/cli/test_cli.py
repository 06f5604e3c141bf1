"""Laws of the command line: results on stdout, one clear sentence and exit code 2 for bad input, nothing written."""

import csv
import io
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest

from t6gps.storage import catalog, tables

TINY = [
    "--set=run.iterations=2",
    "--set=run.episodes=3",
    "--set=run.steps=30",
    "--set=run.evaluation_episodes=2",
    "--set=learner.smallest_class_segments=4",
    "--set=learner.epochs=2",
    "--set=learner.hidden_layers=[16]",
]


def t6gps(*arguments: str | Path, root: Path, code: int = 0) -> subprocess.CompletedProcess[bytes]:
    """Run the command in a process of its own."""
    command = [sys.executable, "-m", "t6gps", *map(str, arguments), "--root", str(root)]
    done = subprocess.run(command, capture_output=True, check=False, timeout=300)
    assert done.returncode == code, done.stderr.decode() + done.stdout.decode()
    return done


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A root with one finished run named `tiny`."""
    folder = tmp_path_factory.mktemp("root")
    done = t6gps("train", "flat-quick", "--run", "tiny", "--serial", *TINY, root=folder)
    printed = done.stdout.decode()
    for word in ("forward m/s", "dataset", "checkpoints", "learning.png", "Try next", "t6gps eval tiny"):
        assert word in printed
    return folder


def test_a_finished_run_has_data_checkpoints_and_figures(root: Path) -> None:
    run = catalog.open_run(root, "tiny")
    assert tables.committed_iterations(run) == 2
    assert tables.read(run, "frames").num_rows == 2 * 3 * 31
    assert len(list(run.checkpoints.glob("iteration-*"))) == 2
    assert {path.name for path in run.figures.glob("*.png")} >= {"learning.png", "ground_track.png", "segments.png"}


def test_eval_prints_the_named_keys_as_json(root: Path) -> None:
    result = json.loads(t6gps("eval", "tiny", "--episodes", "2", "--serial", "--json", root=root).stdout)
    for key in ("forward_speed_m_per_s", "stuck_share", "stuck_share_by_distance", "waypoints_per_episode", "cost"):
        assert set(result[key]) == {"mean", "standard_error"}


def test_eval_changes_the_world_but_not_the_policy(root: Path) -> None:
    arguments = ("eval", "tiny", "--episodes", "2", "--serial", "--json")
    usual = json.loads(t6gps(*arguments, root=root).stdout)
    for change in ("terrain.difficulty=0.5", "randomisation.sensor_noise=0.3"):
        changed = json.loads(t6gps(*arguments, "--set", change, root=root).stdout)
        assert usual["cost"] != changed["cost"]
    refused = t6gps(*arguments, "--set", "learner.kl_weight=1", root=root, code=2)
    assert b"eval cannot change learner.kl_weight" in refused.stderr


def test_query_gives_the_same_rows_in_every_format(root: Path) -> None:
    def answer(form: str) -> bytes:
        sql = "SELECT episode_id, cost FROM episodes ORDER BY episode_id"
        return t6gps("query", "tiny", sql, "--format", form, root=root).stdout

    rows = json.loads(answer("json"))
    assert [row["episode_id"] for row in rows] == list(range(6))
    assert pa.ipc.open_stream(answer("arrow")).read_all().to_pylist() == rows
    read = list(csv.DictReader(io.StringIO(answer("csv").decode())))
    assert [(int(row["episode_id"]), float(row["cost"])) for row in read] == [tuple(row.values()) for row in rows]
    assert "episode_id" in answer("table").decode()


def test_runs_and_show_describe_the_run(root: Path) -> None:
    assert "2 of 2" in t6gps("runs", root=root).stdout.decode()
    printed = t6gps("show", "tiny", root=root).stdout.decode()
    for word in ("Segment classes", "Lambda", "Diagnosis:", "Noise-free policy", "dataset"):
        assert word in printed


def test_render_writes_a_still(root: Path, tmp_path: Path) -> None:
    out = tmp_path / "episode.png"
    t6gps("render", "tiny", "1", "--out", out, root=root)
    assert out.read_bytes().startswith(b"\x89PNG")


def test_resuming_a_finished_run_keeps_it(root: Path) -> None:
    before = tables.read(catalog.open_run(root, "tiny"), "frames")
    t6gps("train", "flat-quick", "--run", "tiny", "--serial", "--resume", *TINY, root=root)
    assert tables.read(catalog.open_run(root, "tiny"), "frames").equals(before)


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
        (["render", "tiny", "99", "--out", "x.png"], ["99", "5"]),
        (["render", "tiny", "0", "--out", "x.gif"], [".png", ".mp4"]),
        (["study", "horizont"], ["unknown study 'horizont'", "did you mean horizon"]),
        (["study", "horizon", "--set=run.steps=15", "--set=run.episodes=60"],
         ["learner.horizon_steps = 20", "longer than an episode"]),
        (["bench", "phisics"], ["unknown benchmark 'phisics'", "physics"]),
    ],
)  # fmt: skip
def test_bad_input_is_refused_in_one_clear_sentence(
    root: Path, tmp_path: Path, arguments: list[str], words: list[str]
) -> None:
    before = sorted(root.rglob("*"))
    refused = t6gps(*arguments, root=root, code=2)
    message = refused.stderr.decode()
    assert refused.stdout == b""
    assert message.startswith("error: ")
    assert "Traceback" not in message
    for word in words:
        assert word in message
    assert sorted(root.rglob("*")) == before


def test_a_root_that_cannot_hold_runs_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("")
    refused = t6gps("train", "flat-quick", root=file / "runs", code=2)
    assert b"must be a writable folder" in refused.stderr


@pytest.mark.slow
@pytest.mark.parametrize("executor", [["--serial"], ["--workers", "1"]])
@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_run_ends_within_seconds_and_resumes(
    tmp_path: Path, wait_until: Callable[..., None], executor: list[str], stop: int
) -> None:
    settings = [*TINY, "--set=run.steps=250", "--set=run.episodes=40", "--set=run.iterations=1"]
    command = ["train", "flat-quick", "--run", "stopped", *executor, *settings]
    started = subprocess.Popen(
        [sys.executable, "-m", "t6gps", *command, "--root", str(tmp_path)],
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    spooled = "stopped/spool/iteration-*/episode-*.arrow"
    wait_until(lambda: started.poll() is not None or len(list(tmp_path.glob(spooled))) >= 2, 120)
    assert started.poll() is None
    os.kill(started.pid, stop)
    _, message = started.communicate(timeout=20)
    assert started.returncode == 130
    assert b"--resume" in message
    assert b"Traceback" not in message
    kept = len(list(tmp_path.glob(spooled)))
    assert 2 <= kept < 40
    t6gps(*command, "--resume", root=tmp_path)
    assert tables.read(catalog.open_run(tmp_path, "stopped"), "episodes").num_rows == 40

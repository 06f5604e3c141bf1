"""Laws of the front door: the import is light, the caller's process stays as it was, and runs say what is stored."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import t6gps
from t6gps.learner import policy as network
from t6gps.storage import catalog, tables
from t6gps.storage.errors import DataError

TINY = {"run.iterations": 2, "run.episodes": 6, "run.steps": 40, "run.evaluation_episodes": 2}
HEAVY = ("numpy", "ray", "torch", "pyarrow", "pydantic", "deltalake", "duckdb", "pybullet", "logging")

IMPORTS = f"""
import os, sys
before = dict(os.environ), set(sys.modules)
import t6gps
assert dict(os.environ) == before[0]
assert not {{name for name in {HEAVY} if name in set(sys.modules) - before[1]}}
"""

THREADS = """
import threadpoolctl, torch
from t6gps.service import threads
def counts(): return {pool["num_threads"] for pool in threadpoolctl.threadpool_info()} | {torch.get_num_threads()}
assert counts() == {2}, counts()
restore = threads.limit()
assert counts() == {1}, counts()
restore()
assert counts() == {2}, counts()
"""


def trains(serial: bool, before: str = "", after: str = "", evaluates_serially: bool = False) -> str:
    """A program that trains, evaluates and asks a run, and sees that its environment and its handlers are the same."""
    return f"""
import os, signal, sys
import t6gps
{before}
def stop(number, frame): raise SystemExit(9)
signal.signal(signal.SIGTERM, stop)
stops = signal.SIGINT, signal.SIGTERM
before = dict(os.environ), [signal.getsignal(number) for number in stops]
run = t6gps.train("flat-quick", root="runs", name=sys.argv[1], settings={TINY}, serial={serial})
t6gps.evaluate(run, episodes=2, serial={serial or evaluates_serially})
run.policy(); run.query("SELECT count(*) FROM frames"); run.episode(0)
assert (dict(os.environ), [signal.getsignal(number) for number in stops]) == before
{after}
"""


def python(code: str, folder: Path, *arguments: str, threads: str | None = None) -> str:
    """What a program writes; it must succeed."""
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    environment |= {} if threads is None else {"OMP_NUM_THREADS": threads}
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def stored(run: t6gps.Run) -> list[object]:
    """Everything of a run but its durations."""
    arrays = sorted(run.path.glob("checkpoints/*/arrays.npz"))
    return [
        *(run.table(name).to_pylist() for name in ("frames", "episodes", "classes")),
        *(file.read_bytes() for file in arrays),
        run.evaluation,
    ]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> t6gps.Run:
    return t6gps.train("flat-quick", root=tmp_path_factory.mktemp("front") / "runs", settings=TINY, serial=True)


def test_the_import_loads_nothing_heavy_changes_nothing_and_says_nothing(tmp_path: Path) -> None:
    assert python(IMPORTS, tmp_path) == ""


def test_every_name_is_there_and_no_other() -> None:
    assert set(t6gps.__all__) <= set(dir(t6gps))
    assert all(getattr(t6gps, name) for name in t6gps.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'tarin'"):
        getattr(t6gps, "tarin")  # noqa: B009 - the type checker knows that there is none


def test_a_name_is_what_the_type_checker_takes_it_for() -> None:
    tree = ast.parse(Path(t6gps.__file__).read_text())
    typed = {
        alias.name: node.module
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and str(node.module).startswith("t6gps.")
        for alias in node.names
    }
    assert {*typed, "__version__"} == set(t6gps.__all__)
    for name, module in typed.items():
        assert getattr(t6gps, name) is getattr(sys.modules[str(module)], name)


@pytest.mark.slow
def test_a_serial_run_depends_on_no_threads_of_its_caller_and_leaves_the_process_as_it_was(
    tmp_path: Path, run: t6gps.Run
) -> None:
    for threads in (None, "2"):
        name = f"threads-{threads}"
        assert python(trains(serial=True, before="import numpy"), tmp_path, name, threads=threads) == ""
        assert stored(t6gps.open_run(tmp_path / "runs" / name)) == stored(run)


@pytest.mark.slow
@pytest.mark.ray
@pytest.mark.parametrize("first", ["", "import ray"])
def test_a_run_on_ray_leaves_the_process_as_it_was(tmp_path: Path, run: t6gps.Run, first: str) -> None:
    after = "import ray; assert not ray.is_initialized(); assert run.status()['state'] == 'DONE'"
    program = trains(serial=False, before=first, after=after, evaluates_serially=bool(first))  # one more Ray is enough
    assert python(program, tmp_path, "ray") == ""
    assert stored(t6gps.open_run(tmp_path / "runs" / "ray")) == stored(run)


@pytest.mark.slow
@pytest.mark.ray
def test_the_ray_of_the_caller_is_used_and_left_running_without_actors(tmp_path: Path, run: t6gps.Run) -> None:
    before = "import ray; ray.init('local', num_cpus=2, include_dashboard=False, logging_level='ERROR')"
    after = (
        "from ray._private.state import actors\n"
        "assert {actor['State'] for actor in actors().values()} == {'DEAD'}\n"
        "assert ray.get(ray.remote(lambda: 3).remote()) == 3"
    )
    python(trains(serial=False, before=before, after=after), tmp_path, "joined")  # its Ray says that workers have ended
    assert stored(t6gps.open_run(tmp_path / "runs" / "joined")) == stored(run)


def test_libraries_compute_with_one_thread_while_it_is_asked_for(tmp_path: Path) -> None:
    assert python(THREADS, tmp_path, threads="2") == ""


def test_a_run_gives_what_is_stored(run: t6gps.Run) -> None:
    folder = catalog.open_run(run.path.parent, run.name)
    assert run == t6gps.open_run(run.path) == t6gps.runs(run.path.parent)[0]
    assert run.episode(3).equals(tables.episode(folder, 3).frames)
    assert run.table("frames", ["step"]).equals(tables.read(folder, "frames", ["step"]))
    assert run.query("SELECT count(*) AS n FROM episodes").to_pylist() == [{"n": 12}]
    assert run.config.run.steps == 40
    assert t6gps.runs(run.path / "nothing") == []


def test_a_policy_commands_what_the_learned_network_does(run: t6gps.Run) -> None:
    policy = run.policy()
    observations = np.array(run.episode(7)["observation"].to_pylist(), np.float32)
    commands = network.act(policy.snapshot, observations[:, : policy.snapshot.layers[0][0].shape[1]])
    np.testing.assert_allclose([policy(row) for row in observations], commands, atol=1e-5)
    assert policy.version == 2
    assert not np.array_equal(run.policy(version=1)(observations[0]), policy(observations[0]))


def test_an_evaluation_says_what_its_settings_make_of_the_policy(run: t6gps.Run) -> None:
    first = t6gps.evaluate(run, episodes=2, seed=0, keep=False, serial=True)
    assert first == run.evaluation
    other = t6gps.evaluate(run, episodes=2, seed=0, settings={"task.directions": 1}, keep=False, serial=True)
    assert other != first
    assert t6gps.evaluate(run, episodes=2, seed=0, version=0, keep=False, serial=True) != first


def test_progress_tells_every_phase_and_every_finished_iteration(run: t6gps.Run, tmp_path: Path) -> None:
    events: list[t6gps.Progress] = []
    again = t6gps.train("flat-quick", root=tmp_path, settings=TINY, serial=True, progress=events.append)
    assert [event.phase for event in events if event.done == event.total and event.iteration == 1] == [
        "sample", "segment", "fit", "backward_pass", "supervise", "finished",
    ]  # fmt: skip
    rows = [event.row for event in events if event.row is not None]
    assert rows == again.table("iterations").to_pylist()
    assert stored(again) == stored(run)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ZeroDivisionError])
def test_an_error_of_progress_stops_the_run_which_can_be_resumed(
    run: t6gps.Run, tmp_path: Path, error: type[BaseException]
) -> None:
    def stop(event: t6gps.Progress) -> None:
        if (event.iteration, event.phase, event.done) == (1, "sample", 3):
            raise error

    with pytest.raises(error):
        t6gps.train("flat-quick", name="stopped", root=tmp_path, settings=TINY, serial=True, progress=stop)
    assert len(list(tmp_path.glob("stopped/spool/*1/episode-*.arrow"))) == 3
    resumed = t6gps.train("flat-quick", name="stopped", root=tmp_path, settings=TINY, serial=True, resume=True)
    assert stored(resumed) == stored(run)


@pytest.mark.parametrize(
    ("attempt", "error", "words"),
    [
        (lambda run: t6gps.train("flat-qick", root=run.path.parent), t6gps.ConfigError, "did you mean flat-quick"),
        (lambda run: t6gps.train("flat", root=run.path.parent, settings={"run.seed": object()}), t6gps.ConfigError,
         r"settings\['run.seed'\].*use numbers"),
        (lambda run: t6gps.train("flat", root=run.path.parent, workers=0), t6gps.ConfigError, "run.workers"),
        (lambda run: t6gps.train("flat-quick", root=run.path.parent, name=run.name), t6gps.RunError, "exists already"),
        (lambda run: t6gps.train("flat-quick", root=run.path.parent, name=run.name, resume=True), t6gps.RunError,
         "another configuration"),
        (lambda run: t6gps.evaluate(run, episodes=1), t6gps.ConfigError, "episodes >= 2, found 1"),
        (lambda run: t6gps.evaluate(run, episodes=2.5), t6gps.ConfigError, "whole episodes >= 2, found 2.5"),
        (lambda run: t6gps.evaluate(run, seed=-1), t6gps.ConfigError, "seed >= 0, found -1"),
        (lambda run: t6gps.evaluate(run, settings={"learner.modes": 3}), t6gps.ConfigError, "cannot change learner"),
        (lambda run: t6gps.open_run(run.path / "nothing"), t6gps.RunError, "there is no run 'nothing'"),
        (lambda run: run.query("DROP TABLE frames"), t6gps.QueryError, "refused"),
        (lambda run: run.table("frames", ["speed"]), DataError, "no column 'speed'"),
        (lambda run: run.episode(99), DataError, "no episode 99"),
        (lambda run: run.policy(version=7), t6gps.RunError, "kept: 0, 1, 2"),
        (lambda run: run.policy()([0.0] * 24), DataError, "83 finite numbers, found 24"),
        (lambda run: run.policy()([float("nan")] * 83), DataError, "0 of them finite"),
        (lambda run: run.policy()("north"), DataError, "83 finite numbers"),
        (lambda run: run.status(), t6gps.RunError, "never run with workers"),
        (lambda run: run.scale(2), t6gps.RunError, "never run with workers"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_words(
    run: t6gps.Run, attempt: Callable[[t6gps.Run], object], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words) as refused:
        attempt(run)
    assert isinstance(refused.value, t6gps.T6GpsError)
    assert t6gps.runs(run.path.parent) == [run]


def test_a_run_without_a_checkpoint_has_no_policy(tmp_path: Path, run: t6gps.Run) -> None:
    bare = t6gps.open_run(catalog.create(tmp_path, "bare", run.config.to_json()).path)
    with pytest.raises(t6gps.RunError, match="no policy yet"):
        bare.policy()
    with pytest.raises(t6gps.RunError, match="no policy yet"):
        t6gps.evaluate(bare, serial=True)
    assert bare.evaluation is None

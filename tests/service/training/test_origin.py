"""Laws of a run's origin: it owns the ground it stands on, says what made it, and what has changed since is told."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import tiny_run
from command import t6gps

from t6gps.service import config as configuration
from t6gps.service.config import Config
from t6gps.service.provenance import compiled, sha256, versions
from t6gps.service.training import evaluation, origin, session
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, TerrainError
from t6gps.storage.schema import SCHEMA_VERSION
from t6gps.workers.ground.ground import ground

REMEDY = "do something"


def hills(seed: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.random.default_rng(seed).normal(size=(81, 81)) / 20


@pytest.fixture
def file(tmp_path: Path) -> Path:
    np.save(tmp_path / "hills.npy", hills(0))
    return tmp_path / "hills.npy"


@pytest.fixture
def config(file: Path) -> Config:
    return configuration.load("flat-quick", [*tiny_run.TINY, "run.iterations=1", f"terrain.file={file}"])


@pytest.fixture
def run(config: Config, tmp_path: Path) -> Run:
    return origin.create(config, tmp_path / "runs", "one")


def rewrite(run: Run, change: Callable[[dict[str, object]], object]) -> None:
    """Change the origin that a run keeps."""
    record = json.loads((run.path / origin.FILE).read_text())
    change(record)
    (run.path / origin.FILE).write_text(json.dumps(record))


def test_a_run_says_what_made_it(run: Run, file: Path) -> None:
    kept = origin.kept(run)
    assert kept is not None
    assert kept.ground == origin.Ground(file="ground/hills.npy", sha256=sha256(file.read_bytes()))
    assert (kept.schema_version, kept.versions, kept.compiled) == (SCHEMA_VERSION, versions(), compiled())
    assert {"t6gps", "pybullet", "numpy", "pyarrow", "torch", "ray", "python"} == set(kept.versions)
    assert len(kept.compiled) == 5
    assert origin.changes(run) is None


def test_a_run_stands_on_the_ground_it_was_created_on_whatever_becomes_of_the_file(run: Run, file: Path) -> None:
    np.save(file, hills(1))
    file.unlink()
    settings = origin.configured(run, ["robot.friction=0.5"]).terrain
    terrain, expected = ground(settings, 0, 0.0), hills(0)
    assert terrain is not None
    np.testing.assert_array_equal(terrain.heights[1:-1, 1:-1], expected[1:-1, 1:-1])


def test_another_ground_is_what_an_evaluation_asks_for(run: Run, tmp_path: Path) -> None:
    other = str(tmp_path / "other.npy")
    assert origin.configured(run, [f"terrain.file={other}"]).terrain.file == other


@pytest.mark.slow
def test_a_run_is_trained_resumed_evaluated_and_drawn_without_the_file_of_its_ground(
    config: Config, run: Run, file: Path, tmp_path: Path
) -> None:
    root, settings = run.path.parent, [f"--set={setting}" for setting in (*tiny_run.TINY, "run.iterations=1")]
    t6gps("train", "flat-quick", "--run", "two", "--serial", "--root", root, *settings, f"--set=terrain.file={file}")
    file.unlink()
    session.complete(config, run, True, tiny_run.Watcher())
    assert evaluation.kept(run) == evaluation.kept(catalog.open_run(root, "two"))
    resume = ("train", "flat-quick", "--run", "one", "--serial", "--resume", f"--set=terrain.file={file}")
    assert "warning" not in t6gps(*resume, "--root", root, *settings).stderr
    t6gps("eval", "one", "--episodes", "2", "--serial", "--root", root)
    t6gps("render", "one", "0", "--out", tmp_path / "still.png", "--root", root)
    t6gps("view", "one", "0", "--out", tmp_path / "episode.rrd", "--root", root)


def test_a_file_is_the_same_ground_by_its_content(run: Run, config: Config, file: Path, tmp_path: Path) -> None:
    session.check_unchanged(run, config, REMEDY)
    copy = tmp_path / "moved.npy"
    file.rename(copy)
    session.check_unchanged(run, config, REMEDY)
    session.check_unchanged(run, configuration.with_ground(config, copy), REMEDY)
    np.save(file, hills(1))
    with pytest.raises(RunError) as refused:
        session.check_unchanged(run, config, REMEDY)
    for words in (f"terrain.file = {file} holds other ground", "the run has", str(run.ground / "hills.npy"), REMEDY):
        assert words in str(refused.value)
    with pytest.raises(RunError, match=r"terrain.file = .*none.npy cannot be read"):
        session.check_unchanged(run, configuration.with_ground(config, tmp_path / "none.npy"), REMEDY)


def test_a_copy_of_the_ground_that_is_altered_or_missing_is_refused(run: Run) -> None:
    np.save(run.ground / "hills.npy", hills(1))
    with pytest.raises(RunError, match=r"its ground .*hills.npy is altered: .* restore"):
        origin.configured(run)
    (run.ground / "hills.npy").unlink()
    with pytest.raises(RunError, match=r"its ground .*hills.npy is missing"):
        origin.configured(run)


def test_a_file_that_is_no_ground_creates_no_run(config: Config, file: Path, tmp_path: Path) -> None:
    np.save(file, np.full((81, 81), np.nan))
    with pytest.raises(TerrainError, match=f"{file}: 6561 heights are not finite"):
        origin.create(config, tmp_path / "none", "one")
    assert not (tmp_path / "none").exists()


def test_what_made_a_run_and_is_another_now_is_told_with_both_values(run: Run) -> None:
    def change(record: dict[str, object]) -> None:
        record["versions"] = {**versions(), "pybullet": "1.2.3"}
        record["commit"] = "elsewhere"

    rewrite(run, change)
    told: list[str] = []
    session.tell_changes(run, told.append)
    (sentence,) = told
    assert f"pybullet 1.2.3 (now {versions()['pybullet']})" in sentence
    assert "commit elsewhere (now" in sentence
    assert "numpy" not in sentence


def test_a_run_of_a_later_version_is_refused(run: Run) -> None:
    rewrite(run, lambda record: record.update(schema_version=SCHEMA_VERSION + 1))
    with pytest.raises(RunError, match=f"tables of version {SCHEMA_VERSION + 1}.*reads up to {SCHEMA_VERSION}"):
        session.tell_changes(run, print)


@pytest.mark.parametrize("record", [None, '{"study": "pair", "arm": "short", "seed": 0, "commits": [], "wall_s": 1.0}'])
def test_a_run_of_an_earlier_version_stands_on_the_file_and_nothing_is_told(
    record: str | None, config: Config, tmp_path: Path, file: Path
) -> None:
    run = catalog.create(tmp_path / "runs", "old", config.to_json())
    if record is not None:
        (run.path / origin.FILE).write_text(record)
    assert origin.kept(run) is origin.changes(run) is None
    assert origin.configured(run) == config
    session.check_unchanged(run, config, REMEDY)


@pytest.mark.parametrize("text", ["", "[]", "3", "{}", '{"schema_version": "x"}', "\xff"])
def test_an_origin_that_cannot_be_read_is_one_clear_error(run: Run, text: str) -> None:
    (run.path / origin.FILE).write_bytes(text.encode("latin-1"))
    with pytest.raises(RunError, match=r"cannot read .*origin.json.*restore"):
        origin.kept(run)

"""Laws of errands: a job's folder comes into the root whole, and takes nobody's place that was not meant."""

from __future__ import annotations

from pathlib import Path

import obstore
import pytest

from t6gps.service.ray_backend import errands
from t6gps.service.ray_backend.jobs_api import RESULT, last_words
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError, RunError, StoreError
from t6gps.storage.objects.place import ObjectPath


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A root, beside the folder that a job was brought in and starts in."""
    for run in ("a", "b"):
        (tmp_path / "brought" / run / "ground").mkdir(parents=True)
        (tmp_path / "brought" / run / "config.toml").write_text(f"# {run}")
    monkeypatch.chdir(tmp_path / "brought")
    return tmp_path / "runs"


def test_folders_are_placed_whole_and_removed_again(root: Path) -> None:
    assert errands.place(str(root), "", "a", "b") == [str(root / ".jobs" / "a"), str(root / ".jobs" / "b")]
    assert (root / ".jobs" / "a" / "config.toml").read_text() == "# a"
    assert (root / ".jobs" / "b" / "ground").is_dir()
    errands.remove(str(root), "a", "b")
    assert not list((root / ".jobs").iterdir())


@pytest.mark.parametrize("taken", [".jobs/b", "b"])
def test_of_several_folders_none_is_placed_where_one_is_in_the_way(root: Path, taken: str) -> None:
    (root / taken).mkdir(parents=True)
    with pytest.raises(RunError, match="b exists already on the cluster; choose another name with --run"):
        errands.place(str(root), "", "a", "b")
    assert not (root / ".jobs" / "a").exists()


def test_a_job_that_is_submitted_again_takes_the_place_of_its_earlier_folder(root: Path) -> None:
    catalog.create(root, "a", "{}")
    (root / ".jobs" / "a").mkdir(parents=True)
    (root / ".jobs" / "a" / "exit_code").write_text("130")
    errands.place(str(root), "again", "a")
    assert sorted(path.name for path in (root / ".jobs" / "a").iterdir()) == ["config.toml", "ground"]


def test_a_root_that_cannot_hold_runs_is_refused_before_ray_is_joined() -> None:
    with pytest.raises(RunError, match=r"root: /proc: .*; needed: a writable folder"):
        errands.look("/proc/runs", "")


def test_the_head_tries_its_keys_and_the_store_and_looks_for_other_runs(
    root: Path, objects: ObjectPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    errands.publish(str(root), str(objects), "a", "b")
    assert objects.below() == {}
    obstore.put(objects.client(), (objects / "b" / "config.json").key, b"of another")
    with pytest.raises(RunError, match=r"/b holds another run of that name"):
        errands.publish(str(root), str(objects), "a", "b")
    with pytest.raises(StoreError, match="there is no bucket 'nowhere'"):
        errands.publish(str(root), "s3://nowhere", "a")
    monkeypatch.delenv("AWS_SECRET_ACCESS_KEY")
    with pytest.raises(ConfigError, match="needs the keys of the object store; set AWS_SECRET_ACCESS_KEY"):
        errands.publish(str(root), str(objects), "a")


def test_an_errand_says_its_result_or_its_error_in_one_line(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    errands.main("status", str(root), "missing")
    assert capsys.readouterr().out == f"{RESULT}null\n"
    with pytest.raises(SystemExit) as ended:
        errands.main("scale", str(root), "missing", "2", "1.0")
    assert ended.value.code == 2
    said = capsys.readouterr().out
    assert said.startswith("error: ")
    assert said.count("\n") == 1


def test_the_last_words_of_a_job_are_its_error() -> None:
    assert last_words(["iteration 1", "error: no room", "", "Job supervisor actor died"]) == "error: no room"
    assert last_words(["iteration 1", " ", "Running entrypoint for job 1: bash train.sh"]) == "iteration 1"
    assert last_words([]) == ""

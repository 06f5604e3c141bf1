"""Laws of the commands that look after data: faults are said and end with 2, a run changes whole or not at all."""

import json
import shutil
from pathlib import Path

import pytest
from command import t6gps
from damages import DEEP, flip
from tiny_run import Trained

import t6gps as package
from t6gps.service.training import verification
from t6gps.storage import catalog
from t6gps.storage.catalog import Run

STUDY = json.dumps({"study": "grip", "arm": "low", "seed": 0, "commits": ["abc"], "wall_s": 1.5, "cores": 2})


@pytest.fixture
def root(tiny: Trained, tmp_path: Path) -> Path:
    """A root of this test's own with the run `tiny`, and another run of its content."""
    for name in ("other", "tiny"):
        shutil.copytree(tiny.run.path, tmp_path / "runs" / name)
    return tmp_path / "runs"


def test_sound_runs_are_said_to_be_and_a_damaged_one_is_named_with_the_file(root: Path) -> None:
    done = t6gps("verify", "--root", root)
    assert done.stdout.decode().splitlines() == ["other: sound", "tiny: sound"]
    file = "tables/frames/iteration-000001.parquet"
    flip(root / "tiny" / file, 5000)
    done = t6gps("verify", "--root", root, code=2)
    assert "other: sound" in done.stdout.decode()
    assert f"tiny: frames: {file}: its SHA-256 is another than its log has" in done.stdout.decode()
    assert "Traceback" not in done.stderr
    runs = json.loads(t6gps("verify", "tiny", "--json", "--root", root, code=2).stdout)["runs"]
    assert [(fault["part"], fault["place"], fault["number"]) for fault in runs["tiny"]] == [("frames", file, 1)]
    assert "no run" in t6gps("verify", "none", "--root", root, code=2).stderr


@pytest.mark.parametrize(
    ("place", "part"),
    [
        ("config.json", "config"),
        ("origin.json", "origin"),
        ("evaluation.json", "evaluation"),
        ("study.json", "study"),
    ],
)
def test_what_the_service_keeps_beside_the_tables_is_verified(root: Path, place: str, part: str) -> None:
    run = Run(root / "tiny")
    (run.path / "study.json").write_text(STUDY)
    content = (run.path / place).read_text()
    for damaged in (
        content[: len(content) // 2],
        content.replace("3", "4") if part == "evaluation" else "",
        "[1]",
        DEEP,
    ):
        (run.path / place).write_text(damaged)
        assert {fault.part for fault in verification.verify(run)} == {part}
    (run.path / place).write_text(content)
    assert verification.verify(run) == []


def test_a_run_that_cannot_be_read_hides_no_other(root: Path) -> None:
    for place in ("config.json", "origin.json", "evaluation.json"):
        (root / "other" / place).write_text(DEEP)
    done = t6gps("verify", "--root", root, code=2)
    assert "tiny: sound" in done.stdout.decode() and "100 deep" in done.stdout.decode()


def test_an_origin_without_a_date_is_a_fault(root: Path) -> None:
    path = root / "tiny" / "origin.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"date": "yesterday"}))
    assert [fault.part for fault in verification.verify(Run(root / "tiny"))] == ["origin"]


@pytest.mark.parametrize(
    ("lost", "part"),
    [
        ("checkpoints", "checkpoints"),
        ("checkpoints/iteration-000003", "checkpoints"),
        ("evaluation.json", "evaluation"),
    ],
)
def test_what_a_finished_run_has_lost_is_seen_and_comes_from_a_copy(root: Path, lost: str, part: str) -> None:
    run = Run(root / "tiny")
    shutil.rmtree(run.path / lost) if (run.path / lost).is_dir() else (run.path / lost).unlink()
    assert [fault.part for fault in verification.verify(run)] == [part]
    refused = t6gps("repair", "tiny", "--root", root, code=2)
    assert "resume the run" in refused.stdout.decode()
    t6gps("repair", "tiny", "--from", root / "other", "--root", root)
    assert verification.verify(run) == []


def test_a_crash_before_a_checkpoint_and_what_a_repair_sets_aside_are_no_losses(root: Path) -> None:
    run, other = Run(root / "tiny"), Run(root / "other")
    shutil.rmtree(run.tables / "evaluations")
    (run.path / "evaluation.json").unlink()
    shutil.rmtree(run.checkpoints / "iteration-000003")
    assert verification.verify(run) == []
    for state in other.checkpoints.iterdir():
        (state / "DONE").unlink()
    t6gps("repair", "other", "--root", root)
    assert verification.verify(other) == []


def test_lost_evaluations_are_seen(root: Path) -> None:
    shutil.rmtree(root / "tiny" / "tables" / "evaluations")
    assert [fault.part for fault in verification.verify(Run(root / "tiny"))] == ["evaluations"]


def test_a_run_is_repaired_from_a_copy_or_says_what_is_lost(root: Path) -> None:
    flip(root / "tiny" / "tables" / "frames" / "iteration-000001.parquet", 5000)
    t6gps("cp", "tiny", "second", "--root", root)
    done = t6gps("repair", "tiny", "--from", root / "other", "--root", root)
    assert "iteration-000001.parquet is taken from" in done.stdout.decode()
    lost = t6gps("repair", "second", "--root", root).stdout.decode()
    assert "iterations from 1 on are set aside in damaged/" in lost
    t6gps("verify", "--root", root)
    (root / "tiny" / "origin.json").unlink()
    done = t6gps("repair", "tiny", "--root", root, code=2)
    assert "not repaired: origin" in done.stdout.decode()


def test_runs_are_copied_renamed_measured_and_removed(root: Path, tmp_path: Path) -> None:
    t6gps("cp", "tiny", "copy", "--to", tmp_path / "far", "--root", root)
    t6gps("mv", "other", "renamed", "--root", root)
    assert [run.name for run in package.runs(root)] == ["renamed", "tiny"]
    assert t6gps("verify", "--root", tmp_path / "far").stdout == b"copy: sound\n"
    listed = t6gps("runs", "--size", "--root", root).stdout.decode()
    size = f"{catalog.size(Run(root / 'tiny')) / 1e6:.1f}"
    assert "MB" in listed and size in listed
    assert "add --yes" in t6gps("rm", "tiny", "--root", root, code=2).stderr
    taken = t6gps("cp", "tiny", "renamed", "--root", root, code=2).stderr
    assert "exists already; choose another name" in taken and "--run" not in taken
    t6gps("rm", "tiny", "--yes", "--root", root)
    assert [run.name for run in package.runs(root)] == ["renamed"]


@pytest.mark.parametrize(
    "command", [("cp", "tiny", "new"), ("mv", "tiny", "new"), ("rm", "tiny", "--yes"), ("repair", "tiny")]
)
def test_a_run_in_use_is_left_alone(root: Path, command: tuple[str, ...]) -> None:
    run = Run(root / "tiny")
    (run.path / ".lock").touch()
    for use in (catalog.locked, catalog.evaluating):
        with use(run):
            assert "in use" in t6gps(*command, "--root", root, code=2).stderr
    assert [other.name for other in catalog.list_runs(root)] == ["other", "tiny"]

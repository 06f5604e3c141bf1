"""Laws of submission: one error and nothing left, or a job that depends on nothing of whoever submitted it."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command import t6gps

from t6gps.service import config as configuration
from t6gps.service.launch import folder as folders
from t6gps.service.launch import job as records
from t6gps.service.launch import submission
from t6gps.service.launch import target as targets
from t6gps.service.launch.folder import Folder, Planned
from t6gps.service.launch.target import Kind, Local, Slurm
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError, RunError


@pytest.fixture(autouse=True)
def states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The user's folder of states."""
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "state"))
    monkeypatch.delenv("T6GPS_TARGET", raising=False)
    return tmp_path / "state"


def entries(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def target_file(folder: Path, text: str) -> Path:
    path = folder / "targets.toml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("preset", configuration.presets())
def test_a_configuration_written_as_toml_is_read_as_the_same(preset: str, tmp_path: Path) -> None:
    config = configuration.load(preset, ["run.pipelined=true", "learner.hidden_layers=[8, 4]"])
    file = tmp_path / "config.toml"
    file.write_text(config.to_toml(), encoding="utf-8")
    assert configuration.load(str(file)) == config


def test_a_target_is_what_its_section_says_and_the_cluster_decides_the_rest(tmp_path: Path) -> None:
    file = target_file(tmp_path, "[slurm]\npartition = 'cpu'\nnodes = 4\n[k8s]\nimage = 'x'\n")
    target = targets.read(Kind.SLURM, file)
    assert isinstance(target, Slurm)
    assert (target.partition, target.nodes, target.account) == ("cpu", 4, None)
    assert targets.read(Kind.LOCAL, None) == Local()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[slurm]\nnode = 4", ["slurm.node", "allowed: partition (partition)"]),
        ("[slurm]\nnodes = 0", ["slurm.nodes", "found 0"]),
        ("[slurm]\npartition = 'a b'", ["slurm.partition", "'a b'"]),
        ("[slurm]\nminutes = 2026-11-27", ["[slurm]", "numbers, strings"]),
        ("slurm = 3", ["slurm: Input should be an object", "targets.toml"]),
        ("[slum]\nnodes = 1", ["unknown section [slum]", "[slurm]"]),
        ("[local]", ["no section [slurm]"]),
        ("[slurm", ["not TOML"]),
    ],
)
def test_a_file_of_targets_that_makes_no_sense_is_refused(tmp_path: Path, text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as error:
        targets.read(Kind.SLURM, target_file(tmp_path, text))
    assert all(word in " ".join(str(error.value).split()) for word in words), str(error.value)


@pytest.mark.parametrize(
    ("programs", "words"),
    [
        ({}, ["no program sbatch", "login node"]),
        ({"sbatch": "exit 0", "squeue": "exit 0", "scancel": "exit 0"}, ["no program scontrol"]),
        ({"sbatch": "exit 0", "squeue": "exit 0", "scancel": "exit 0", "scontrol": "echo is DOWN"}, ["DOWN", "sinfo"]),
        (
            {"sbatch": "echo Incompatible versions of client and server code >&2; exit 1"},
            ["Incompatible versions of client and server code"],
        ),
        (
            {
                "sbatch": 'case "$1" in --version) ;; *) echo no such partition >&2; exit 1 ;; esac',
                "squeue": "exit 0", "scancel": "exit 0", "scontrol": "echo is UP",
            },
            ["no such partition", "correct the file of targets"],
        ),
        (
            {
                "sbatch": 'case "$1" in --parsable) echo full >&2; exit 1 ;; esac',
                "squeue": "exit 0", "scancel": "exit 0", "scontrol": "echo is UP",
            },
            ["Slurm refused sbatch: full"],
        ),
    ],
)  # fmt: skip
def test_a_cluster_that_cannot_be_used_gives_one_error_and_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, programs: dict[str, str], words: list[str]
) -> None:
    (tmp_path / "bin").mkdir()
    for name, text in programs.items():
        (tmp_path / "bin" / name).write_text(f"#!/bin/sh\n{text}\n")
        (tmp_path / "bin" / name).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "bin"))
    done = t6gps("submit", "flat-quick", "--to", "slurm", "--run", "a", "--root", tmp_path / "runs", code=2)
    assert all(word in " ".join(done.stderr.split()) for word in words), done.stderr
    assert not (tmp_path / "runs" / ".jobs" / "a").exists()
    assert not records.jobs()


def test_a_root_that_cannot_hold_jobs_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    done = t6gps("submit", "flat-quick", "--root", tmp_path / "file", code=2)
    assert "must be a writable folder" in " ".join(done.stderr.split())
    assert not records.jobs()


def test_a_dry_run_says_everything_and_does_nothing(tmp_path: Path, states: Path) -> None:
    target = target_file(tmp_path, "[slurm]\nnodes = 3\naccount = 'robots'\n")
    before = entries(tmp_path)
    options = ["--to", "slurm", "--target", target, "--root", tmp_path / "runs", "--seeds", "2", "--dry-run"]
    said = t6gps("submit", "flat-quick", *options).stdout.decode()
    for words in ("run.iterations = 10", "--nodes=3", "--account=robots", "--array=0-1", "#SBATCH --requeue"):
        assert words in said
    assert f"--output={tmp_path}/runs/.jobs/flat-quick-seed%a/log" in said
    assert entries(tmp_path) == before


def test_a_job_has_its_ground_and_configuration_in_the_root(tmp_path: Path) -> None:
    source = tmp_path / "hill.npy"
    np.save(source, np.linspace(0, 1, 81 * 81).reshape(81, 81))
    planned = submission.plan("flat-quick", [f"terrain.file={source}"], tmp_path / "runs", "a", None, False)[0]
    with folders.prepared(planned):
        source.unlink()
    copy = planned.folder.path / "ground" / "hill.npy"
    assert configuration.load(str(planned.folder.config)).terrain.file == str(copy)
    assert np.load(copy).shape == (81, 81)


def test_a_folder_that_is_written_for_another_root_has_its_ground_there(tmp_path: Path) -> None:
    source = tmp_path / "hill.npy"
    np.save(source, np.linspace(0, 1, 81 * 81).reshape(81, 81))
    config = configuration.load("flat-quick", [f"terrain.file={source}"])
    (tmp_path / "draft").mkdir()
    folders.write(Planned(config, Folder(Path("/mnt/runs/.jobs/a"))), tmp_path / "draft")
    assert (tmp_path / "draft" / "ground" / "hill.npy").read_bytes() == source.read_bytes()
    written = configuration.load(str(tmp_path / "draft" / "config.toml"))
    assert written.terrain.file == "/mnt/runs/.jobs/a/ground/hill.npy"


@pytest.mark.parametrize("publish", [None, "s3://lab/runs"])
def test_the_script_of_a_job_publishes_where_its_folder_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, publish: str | None
) -> None:
    program = tmp_path / "bin" / "t6gps"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\nprintf "%s\\n" "$@" > {tmp_path}/said\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    planned = submission.plan("flat-quick", [], tmp_path / "a root", "a", None, False, publish)[0]
    with folders.prepared(planned):
        assert planned.folder.publish == publish
    assert subprocess.run(["bash", "-u", planned.folder.script, planned.folder.path], check=False).returncode == 0
    said = (tmp_path / "said").read_text().splitlines()
    expected = ["train", str(planned.folder.config), "--run", "a", "--root", str(tmp_path / "a root"), "--resume"]
    assert said == expected + ([] if publish is None else ["--publish", publish])


def test_a_run_that_is_continued_is_published_as_before(tmp_path: Path) -> None:
    config = configuration.load("flat-quick")
    run = catalog.create(tmp_path, "a", config.to_json())
    assert submission.continuing(run, config).publish is None
    with folders.prepared(Planned(config, folders.of(tmp_path, "a"), "s3://lab/runs")):
        pass
    assert submission.continuing(run, config).publish == "s3://lab/runs"


@pytest.mark.parametrize(
    ("address", "sentence"),
    [("elsewhere", "--publish takes s3://BUCKET/PREFIX, found 'elsewhere'"), ("s3://lab/runs", "s3:// needs the keys")],
)
def test_a_job_that_could_not_publish_is_not_submitted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str, sentence: str
) -> None:
    monkeypatch.delenv("AWS_ACCESS_KEY_ID", raising=False)
    done = t6gps("submit", "flat-quick", "--root", tmp_path / "runs", "--publish", address, code=2)
    assert sentence in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "runs").exists()
    assert not records.jobs()


def test_a_job_of_slurm_takes_the_keys_along_where_it_publishes(tmp_path: Path) -> None:
    options = ("submit", "flat-quick", "--to", "slurm", "--root", tmp_path, "--dry-run")
    assert "--export=ALL" not in t6gps(*options).stdout.decode().partition("#!")[0]
    said = t6gps(*options, "--publish", "s3://lab/runs").stdout.decode().partition("#!")[0]
    assert "--export=ALL" in said and "# each run is published below s3://lab/runs" in said


def test_a_submission_that_fails_puts_the_earlier_folder_back(tmp_path: Path) -> None:
    planned = Planned(configuration.load("flat-quick"), folders.of(tmp_path, "a"))
    folder = planned.folder
    with folders.prepared(planned):
        pass
    folder.log.write_text("what the first job wrote\n")
    before = entries(tmp_path)
    with pytest.raises(RunError, match="refused"), folders.prepared(planned):
        assert folder.log.read_text() == "what the first job wrote\n"
        raise RunError("refused")
    assert entries(tmp_path) == before


def test_names_that_are_taken_are_refused_or_numbered(tmp_path: Path) -> None:
    config = configuration.load("flat-quick")
    catalog.create(tmp_path, "flat-quick", config.to_json())
    with folders.prepared(Planned(config, folders.of(tmp_path, "flat-quick-2"))):
        pass
    assert submission.plan("flat-quick", [], tmp_path, None, None, False)[0].folder.run == "flat-quick-3"
    for name in ("flat-quick", "flat-quick-2"):
        with pytest.raises(RunError, match="exists already; choose another name with --run, or add --resume"):
            submission.plan("flat-quick", [], tmp_path, name, None, False)
    with pytest.raises(RunError, match=r"another configuration: run.seed = 3"):
        submission.plan("flat-quick", ["run.seed=3"], tmp_path, "flat-quick", None, True)


def test_a_job_is_found_by_its_run_in_its_root_and_by_its_name_elsewhere(tmp_path: Path) -> None:
    here, there = folders.of(tmp_path / "here", "a"), folders.of(tmp_path / "there", "a")
    records.make_state_folder()
    first, second = (records.new(Kind.LOCAL, "x:1:1", folder, "flat-quick", Local()) for folder in (here, there))
    assert (first.name, second.name) == ("a", "a-2")
    assert records.find(tmp_path / "there", "a") == second
    assert records.find(tmp_path / "elsewhere", "a-2") == second
    catalog.create(tmp_path / "elsewhere", "a-2", "{}")
    assert records.find(tmp_path / "elsewhere", "a-2") is None
    again = records.new(Kind.LOCAL, "x:2:2", here, "flat-quick", Local())
    assert records.jobs() == [second, again]


def test_jobs_lists_the_others_where_one_target_cannot_be_asked(tmp_path: Path) -> None:
    records.make_state_folder()
    for run, host in (("here", socket.gethostname()), ("there", "elsewhere")):
        records.new(Kind.LOCAL, f"{host}:1:1", folders.of(tmp_path, run), "flat-quick", Local())
    rows = {row["name"]: row for row in json.loads(t6gps("jobs", "--json").stdout)}
    assert rows["there"]["state"] is None
    assert "ask there" in rows["there"]["detail"]
    assert rows["here"]["state"] == "failed"
    assert "without a word or a log; let its nodes share the root" in rows["here"]["detail"]


def test_a_record_that_is_damaged_is_named(states: Path) -> None:
    records.make_state_folder()
    (states / "jobs" / "a.json").write_text('{"name": "a"}')
    assert "a.json" in t6gps("jobs", code=2).stderr.replace("\n", "")


def test_a_state_folder_that_cannot_be_made_is_refused_before_anything_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path / "file"))
    done = t6gps("submit", "flat-quick", "--root", tmp_path / "runs", code=2)
    assert "set T6GPS_STATE" in " ".join(done.stderr.split())
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    ("command", "words"),
    [("logs", "there is no job 'nothing'; jobs: none"), ("stop", "there is no run 'nothing'")],
)
def test_a_name_of_nothing_is_refused_with_what_there_is(command: str, words: str, tmp_path: Path) -> None:
    assert words in t6gps(command, "nothing", "--root", tmp_path, code=2).stderr.replace("\n", " ")


def test_outcomes_are_those_of_the_exit_code(tmp_path: Path) -> None:
    folder = folders.of(tmp_path, "a")
    folder.path.mkdir(parents=True)
    assert records.outcome(folder)[0] == "failed"
    folder.log.write_text("error: the reason\n\n")
    for code, state, words in (("0", "done", ""), ("130", "stopped", ""), ("2", "failed", "error: the reason")):
        (folder.path / "exit_code").write_text(code + "\n")
        assert records.outcome(folder) == (state, words)

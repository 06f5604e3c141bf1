"""Laws of `t6gps policy`: a version leaves as a file, and the file alone drives the simulator as `eval` does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command import t6gps
from tiny_run import Trained

from t6gps.service.policies import files
from t6gps.service.policies.files import Format


@pytest.fixture(scope="module")
def header(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run's policy of version 1 in C."""
    out = tmp_path_factory.mktemp("exported") / "rolling.h"
    root = tiny.run.path.parent
    done = t6gps("policy", "export", "tiny", "--version", "1", "--format", "c", "--out", out, "--root", root)
    assert done.stdout.decode() == f"{out}\n"
    assert 'call it: #include "rolling.h"' in done.stderr
    return out


def test_a_file_drives_the_episodes_of_eval(tiny: Trained, header: Path, tmp_path: Path) -> None:
    own = t6gps("eval", "tiny", "--policy", "1", "--episodes", "2", "--seed", "7", "--serial", "--no-keep", "--json",
                "--root", tiny.run.path.parent)  # fmt: skip
    picture = tmp_path / "first.png"
    driven = t6gps("policy", "run", header, "--episodes", "2", "--seed", "7", "--json", "--render", picture)
    assert json.loads(driven.stdout) == json.loads(own.stdout)
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_file_drives_in_another_world_and_prints_what_it_measured(header: Path) -> None:
    arguments = ["policy", "run", header, "--episodes", "2", "--set", "run.steps=5"]
    smooth, rough = (t6gps(*arguments, *world, "--json").stdout for world in ([], ["--set", "robot.friction=0.1"]))
    assert json.loads(smooth)["cost"] != json.loads(rough)["cost"]
    assert "forward_speed_m_per_s" in t6gps(*arguments).stdout.decode()


@pytest.mark.parametrize("form", Format)
def test_the_newest_policy_leaves_by_the_name_of_its_run(
    form: Format, tiny: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    t6gps("policy", "export", "tiny", "--format", form, "--root", tiny.run.path.parent)
    (file,) = tmp_path.iterdir()
    assert file.name == f"tiny-3{files.FORMS[form].suffix}"
    assert files.opened(file).description.policy_version == 3


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["export", "tiny", "--format", "c", "--version", "9"], "keeps no policy of version 9; kept: 0, 1, 2, 3"),
        (["export", "tniy", "--format", "c"], "tiny"),
        (["export", "tiny", "--format", "c", "--out", "policy.onnx"], "ends in .h, found policy.onnx"),
        (["export", "tiny", "--format", "c", "--out", "none/policy.h"], "cannot write none/policy.h"),
        (["export", "tiny", "--format", "c", "--out", "there.h"], "there.h exists already"),
        (["run", "missing.h"], "cannot read the policy missing.h"),
        (["run", "there.h"], "there.h is no header of a policy"),
        (["run", "there.onnx"], "there.onnx is no ONNX model"),
        (["run", "policy.gz"], "allowed: .onnx (onnx), .pt (torchscript), .h (c)"),
    ],
)
def test_what_cannot_be_done_is_one_error_and_leaves_nothing(
    arguments: list[str], words: str, tiny: Trained, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    there = [tmp_path / name for name in ("there.h", "there.onnx")]
    for file in there:
        file.write_text("something else")
    root = ["--root", str(tiny.run.path.parent)] if arguments[0] == "export" else []
    done = t6gps("policy", *arguments, *root, code=2)
    assert words in done.stderr.splitlines()[-1]
    assert sorted(tmp_path.iterdir()) == there
    assert all(file.read_text() == "something else" for file in there)


def test_a_picture_that_cannot_be_written_is_refused_before_the_robot_moves(header: Path) -> None:
    done = t6gps("policy", "run", header, "--render", "first.gif", code=2)
    assert "allowed: .png (picture), .mp4 (film)" in done.stderr

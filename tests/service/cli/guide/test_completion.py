"""Laws of completion: each shell gets commands, options and what they take, at once and as the commands are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from t6gps.service.cli.guide import completion, described
from t6gps.service.cli.main import app
from t6gps.storage import catalog

SLOW = ("numpy", "pyarrow", "duckdb", "ray", "torch")


def environment(shell: str, line: str) -> dict[str, str]:
    """What the scripts of a shell set for the words of a line, of which the last is not complete."""
    words = {"COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1), "_TYPER_COMPLETE_ARGS": line}
    return words | {"_TYPER_COMPLETE_FISH_ACTION": "get-args", completion.VARIABLE: f"complete_{shell}"}


def offered(line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """What bash is offered for a line."""
    for name, value in environment("bash", line).items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        completion.answer()
    return capsys.readouterr().out.split()


@pytest.mark.parametrize(
    ("shell", "answer"),
    [
        ("bash", "robot.friction=1.0\n"),
        ("zsh", """_arguments '*: :(("robot.friction=1.0":"effective coefficient between bars and ground"))'\n"""),
        ("fish", "robot.friction=1.0\teffective coefficient between bars and ground\n"),
    ],
)
def test_a_shell_is_answered_in_its_protocol(shell: str, answer: str) -> None:
    words = environment(shell, "t6gps train --set robot.fr")
    done = subprocess.run(
        [sys.executable, "-m", "t6gps"], env=os.environ | words, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, answer, "")


@pytest.mark.parametrize(
    ("line", "answer"),
    [
        ("t6gps tr", ["train"]),
        ("t6gps token re", ["revoke"]),
        ("t6gps export m", ["mjcf", "minari"]),
        ("t6gps train --se", ["--server", "--serial", "--set"]),
        ("t6gps train rough", ["rough", "rough-quick"]),
        ("t6gps train rough --set run.pipe", ["run.pipelined=false", "run.pipelined=true"]),
        ("t6gps train rough --set=terrain.acc", ["terrain.accept="]),
        ("t6gps eval rough --set learner.mode_s", ["learner.mode_search=ransac", "learner.mode_search=gaussian"]),
        ("t6gps eval --engine ", ["bullet", "mujoco"]),
        ("t6gps study hor", ["horizon"]),
        ("t6gps bench phy", ["physics"]),
        ("t6gps schema stu", ["stuck"]),
    ],
)
def test_what_can_be_written_is_offered(
    line: str, answer: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert offered(line, monkeypatch, capsys) == answer


def test_runs_are_those_of_the_root_and_jobs_are_the_users(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for root, run in (("runs", "walker"), ("runs", "roller"), ("other", "climber")):
        catalog.create(tmp_path / root, run, "{}")
    (tmp_path / "jobs").mkdir()
    (tmp_path / "jobs" / "sweeper.json").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("T6GPS_STATE", str(tmp_path))
    monkeypatch.delenv("T6GPS_ROOT", raising=False)
    assert offered("t6gps show ", monkeypatch, capsys) == ["roller", "walker"]
    assert offered("t6gps verify roller w", monkeypatch, capsys) == ["walker"]
    assert offered("t6gps stop ", monkeypatch, capsys) == ["roller", "sweeper", "walker"]
    assert offered("t6gps query --root other ", monkeypatch, capsys) == ["climber"]
    assert offered("t6gps show --root s3://lab/runs ", monkeypatch, capsys) == []
    assert offered("t6gps show --root nowhere ", monkeypatch, capsys) == []
    assert offered("t6gps show --server http://127.0.0.1:9 ", monkeypatch, capsys) == []
    monkeypatch.setenv("T6GPS_ROOT", "other")
    assert offered("t6gps show ", monkeypatch, capsys) == ["climber"]


def test_an_answer_loads_nothing_slow() -> None:
    script = (
        "import sys; from t6gps.service.cli.guide import completion\n"
        "try: completion.answer()\n"
        f"finally: print([name for name in {SLOW} if name in sys.modules])"
    )
    words = environment("bash", "t6gps train --set robot.fr")
    done = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | words, capture_output=True, text=True, check=True
    )
    assert done.stdout == "robot.friction=1.0\n[]\n"


def test_what_is_offered_is_what_the_commands_are() -> None:
    stored = completion.FILE.read_text(encoding="utf-8")
    assert stored == described.text(app), "run make docs"

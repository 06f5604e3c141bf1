"""Laws of logs: text for people as ever, or an object a line that says who speaks."""

from __future__ import annotations

import json
import logging
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from command import t6gps
from tiny_run import settings

from t6gps.service import logs
from t6gps.service.launch.folder import Folder
from t6gps.service.launch.job import last_words
from t6gps.service.logs import Format, Role, Speaker

JSON = Speaker(Format.JSON, Role.WORKER, "walk", slot=3)
log = logging.getLogger("t6gps.tests")


@pytest.fixture(autouse=True)
def as_before() -> Iterator[None]:
    """Let later tests find text."""
    yield
    logs.begin(Speaker())


def lines(text: str) -> list[dict[str, Any]]:
    """The objects of a text, which has nothing else."""
    return [json.loads(line) for line in text.splitlines()]


def test_a_line_says_when_how_bad_who_and_what(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin(JSON)
    with logs.speaking(replace(logs.speaker(), episode=0)):
        log.warning("no %s\nat all", "ground")
    log.info("over")
    first, second = lines(capsys.readouterr().err)
    assert datetime.fromisoformat(first.pop("time")).utcoffset() is not None
    assert first == {
        "level": "warning", "logger": "t6gps.tests", "message": "no ground\nat all",
        "run": "walk", "role": "worker", "slot": 3, "episode": 0,
    }  # fmt: skip
    assert second["level"] == "info"
    assert "episode" not in second


def test_a_line_about_somebody_else_names_them(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin(Speaker(Format.JSON, Role.SUPERVISOR, "walk"))
    log.info("a worker has died", extra={"slot": 0, "episode": 7})
    (line,) = lines(capsys.readouterr().err)
    assert (line["role"], line["slot"], line["episode"]) == ("supervisor", 0, 7)


def test_tracebacks_warnings_and_lines_of_libraries_and_threads_are_objects_too(
    capsys: pytest.CaptureFixture[str],
) -> None:
    logs.begin(JSON)
    library = logging.getLogger("ray")
    library.propagate = False
    library.addHandler(logging.StreamHandler())
    logs.adopt("ray")
    try:
        raise ValueError("of ours")
    except ValueError:
        log.exception("it failed")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn("old", stacklevel=1)
    library.error("lost")
    thread = threading.Thread(target=log.info, args=("beside",))
    thread.start()
    thread.join()
    found = lines(capsys.readouterr().err)
    assert "ValueError: of ours" in found[0]["exception"]
    assert [line["logger"] for line in found] == ["t6gps.tests", "py.warnings", "ray", "t6gps.tests"]
    assert {line["run"] for line in found} == {"walk"}


def test_text_is_left_to_python(capsys: pytest.CaptureFixture[str]) -> None:
    logs.begin(JSON)
    logs.begin(Speaker())
    assert not [handler for handler in logging.getLogger().handlers if type(handler).__module__ == logs.__name__]
    assert not logging.getLogger("t6gps").isEnabledFor(logging.INFO)
    assert not capsys.readouterr().err


def test_who_works_for_somebody_is_of_the_same_run_and_format() -> None:
    logs.begin(Speaker(Format.JSON, Role.SUPERVISOR, "walk", episode=3))
    assert logs.other(Role.WORKER, slot=2) == Speaker(Format.JSON, Role.WORKER, "walk", 2)
    assert logs.other(Role.SUPERVISOR, "run").run == "run"


def test_the_last_words_of_a_job_are_its_message_in_either_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    logs.begin(JSON)
    log.error("the disk is full")
    folder = Folder(tmp_path)
    for text in (capsys.readouterr().err, "the disk is full\n", '"the disk"\nthe disk is full\n\n'):
        folder.log.write_text("before\n" + text)
        assert last_words(folder) == "the disk is full"
    assert [logs.said(line) for line in ("3", '{"a": 1}', "{", "")] == ["3", '{"a": 1}', "{", ""]


def test_another_format_is_one_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(logs.VARIABLE, "xml")
    said = t6gps("runs", "--root", tmp_path, code=2).stderr
    assert "T6GPS_LOG_FORMAT takes text or json, found 'xml'" in said


def test_an_error_is_an_object_and_results_are_as_ever(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = t6gps("runs", "--root", tmp_path)
    monkeypatch.setenv(logs.VARIABLE, "json")
    assert t6gps("runs", "--root", tmp_path).stdout == text.stdout
    (line,) = lines(t6gps("show", "none", "--root", tmp_path, code=2).stderr)
    assert (line["level"], line["role"]) == ("error", "command")
    assert "no run 'none'" in line["message"]


@pytest.mark.slow
def test_every_line_of_a_run_is_an_object_with_run_and_role(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(logs.VARIABLE, "json")
    run = ["--run", "walk", "--serial", "--root", str(tmp_path)]
    said = lines(t6gps("train", "flat-quick", *run, *settings()).stderr)
    taken = t6gps("train", "flat-quick", *run, *settings(), code=2).stderr
    found = [*said, *lines(taken)]
    assert sum("is committed" in line["message"] or line["message"].startswith("iteration") for line in said) == 3
    assert found[-1]["level"] == "error"
    assert {(line["run"], line["role"]) for line in found} == {("walk", "supervisor")}

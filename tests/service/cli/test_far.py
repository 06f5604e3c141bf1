"""Laws of --server: every command does through a server what it does with its root, and refuses in the same words."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import click
import pytest
import run_digest
import typer.main
from command import t6gps
from loopback import listening
from tiny_run import Trained

from t6gps.service.cli import door
from t6gps.service.cli.data import figures
from t6gps.service.cli.main import app
from t6gps.service.launch import folder as folders
from t6gps.service.launch import job as records
from t6gps.service.launch.target import Kind, Local
from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.server import app as application
from t6gps.service.server import tokens
from t6gps.service.server.guard import utc_now
from t6gps.service.steering.events import EventKind, EventLog, Happened
from t6gps.storage import catalog

COMMANDS: dict[str, click.Command] = getattr(typer.main.get_command(app), "commands", {})
HERE_ALONE = {
    "bench": "measures this machine",
    "cp": "copies folders of this machine; fetch brings a run from a server",
    "doctor": "looks at this machine",
    "export": "writes files of this machine, of runs that fetch brings",
    "mv": "moves folders of this machine",
    "policy": "runs a file of this machine; its export takes a server",
    "repair": "changes folders of this machine, by copies that it sees",
    "schema": "needs no run",
    "replay": "takes a file of this machine, which fetch brings",
    "rm": "removes folders of this machine for good",
    "serve": "is the server",
    "study": "conducts many runs, each of which train --server could start",
    "verify": "reads every byte, so it works where the files are",
    "submit": "chooses where a job runs; train --server submits to the server's machine",
}
"""Commands that know no server, and why."""
SQL = "SELECT iteration, avg(cost) AS cost FROM episodes GROUP BY iteration ORDER BY iteration"
ANSWERS = {
    "runs": [[]],
    "show": [["tiny"]],
    "query": [
        ["tiny", SQL],
        *(["tiny", SQL, "--format", form] for form in ("csv", "json", "arrow")),
        ["t*", "SELECT run, run_seed + $more AS n FROM runs", "--param", "more=2", "--format", "csv"],
    ],
    "status": [["tiny"], ["tiny", "--json"], ["paused"], ["paused", "--json"]],
    "events": [["paused"], ["paused", "--json"], ["tiny"]],
    "jobs": [[], ["--json"]],
    "logs": [["tiny"], ["tiny", "-f"]],
    "eval": [["tiny", "--episodes", "2", "--serial", "--json", "--no-keep", "--set", "terrain.difficulty=0.5"]],
    "token": [["list", "--json"]],
}
"""What commands are asked that read."""
REFUSALS = {
    "runs": [],
    "show": [["none"], ["a/b"]],
    "query": [["none", SQL], ["none*", SQL], ["tiny", "SELEC"], ["tiny", "SELECT x"], ["tiny", "SELECT $x"]],
    "status": [["none"], ["a/b"]],
    "events": [["none"]],
    "logs": [["none"], ["paused"]],
    "eval": [["none", "--serial"], ["paused", "--serial"], ["tiny", "--set", "learner.epochs=1"]],
    "render": [
        ["tiny", "99", "--out", "x.png"],
        ["none", "0", "--out", "x.png"],
        ["tiny", "0", "--out", "x.gif"],
        ["tiny", "0", "--evaluation", "7", "--out", "x.png"],
        ["tiny", "99", "--evaluation", "0", "--out", "x.png"],
    ],
    "view": [
        ["tiny", "99", "--out", "x.rrd"],
        ["none", "0", "--out", "x.rrd"],
        ["tiny", "--out", "x.rrd"],
        ["tiny", "--pick", "best:99", "--out", "x.rrd"],
        ["tiny", "--pick", "best:3", "--evaluation", "0", "--out", "x.rrd"],
        ["tiny", "0", "--evaluation", "7", "--out", "x.rrd"],
    ],
    "figures": [["paused"], ["tiny", "--evaluation", "7"]],
    "fetch": [["none"], ["tiny", "--run", "../up"]],
    "scale": [["paused", "2"], ["none", "2"], ["tiny", "2"]],
    "pause": [["paused"], ["none"]],
    "unpause": [["paused"], ["none"]],
    "stop": [["paused"], ["tiny"], ["none"]],
    "train": [
        ["flat-quick", "--run", "tiny"],
        ["flat-quick", "--run", "tiny", "--resume"],
        ["flat-quik"],
        ["flat-quick", "--set", "run.iterations=0"],
    ],
    "token": [["revoke", "none"], ["create", "me"]],
}
"""What commands are asked that cannot be."""


@pytest.fixture(scope="module")
def place(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Path, str]]:
    """A root and its server: the run `tiny` that a job has trained, and `paused`, whose process has ended."""
    home = tmp_path_factory.mktemp("far")
    root = home / "runs"
    catalog.copy(tiny.run, root, "tiny")
    paused = catalog.create(root, "paused", tiny.config.to_json())
    log = EventLog(paused.pool)
    log.write([Happened(EventKind.START, "slot 0: 1 wanted"), Happened(EventKind.PAUSED, "asked for")], "sampling")
    head = {"time_s": 0.0, "pid": 1, "request": None, "most": 4}
    state = {"state": "PAUSED", "reason": "", "phase": "sampling", "wanted": 0, "ready": 0}
    counts = {"backlog": 3, "leases": 0, "arrived": 0, "bytes_in_flight": 0, "waits": []}
    lists = {"workers": [], "quarantined": [7], "episodes": {"committed": 4}, "processes": {}}
    (paused.pool / "status.json").write_text(json.dumps({**head, **state, **counts, **lists}))
    token = tokens.issue(root, TokenRequest(name="me", scope=Scope.ADMIN, days=1.0), utc_now()).token
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("T6GPS_STATE", str(home / "state"))
        patch.setenv("T6GPS_TOKEN", token)
        patch.chdir(home)
        folder = folders.of(root, "tiny")
        folder.path.mkdir(parents=True)
        folder.log.write_text("a" + "ä" * 2**20 + "\n", encoding="utf-8")  # more than a piece, which cuts a letter
        folder.end(0)
        records.make_state_folder()
        records.new(Kind.LOCAL, f"{socket.gethostname()}:{os.getpid()}:0", folder, "flat-quick", Local())
        with listening(application.create(root)) as url:
            yield root, url


def asked(place: tuple[Path, str], command: str, arguments: list[str], code: int = 0) -> list[tuple[bytes, str]]:
    """What a command says on its streams, with the root and through the server; names of both places aside."""
    root, url = place
    said = []
    for where in ([] if command == "jobs" else ["--root", str(root)], ["--server", url]):
        done = t6gps(command, *arguments, *where, code=code)
        table = done.stdout[done.stdout.find("┏".encode()) :] if command == "runs" else done.stdout
        said.append((table.partition(b"dataset  ")[0], done.stderr))  # folders are told here alone
    return said


def test_every_command_takes_a_server_or_says_why_not() -> None:
    def options(command: click.Command) -> set[str]:
        inner = getattr(command, "commands", {}).values()
        own = {option for parameter in command.params for option in parameter.opts}
        return set.intersection(*map(options, inner)) if inner else own

    far = {name for name, command in COMMANDS.items() if "--server" in options(command)}
    assert far == COMMANDS.keys() - HERE_ALONE.keys()
    assert far == ANSWERS.keys() | REFUSALS.keys()


@pytest.mark.parametrize(("command", "arguments"), [(name, each) for name in ANSWERS for each in ANSWERS[name]])
def test_a_command_says_the_same_through_a_server(place: tuple[Path, str], command: str, arguments: list[str]) -> None:
    here, far = asked(place, command, arguments)
    assert here == far
    assert here[0] or (command, arguments) == ("events", ["tiny"])


@pytest.mark.parametrize(("command", "arguments"), [(name, each) for name in REFUSALS for each in REFUSALS[name]])
def test_a_command_refuses_in_the_same_words_through_a_server(
    place: tuple[Path, str], command: str, arguments: list[str]
) -> None:
    here, far = asked(place, command, arguments, code=2)
    assert here == far
    assert here[1].startswith("error: ")


def test_pictures_and_runs_come_home_with_the_same_bytes(
    place: tuple[Path, str], tiny: Trained, tmp_path: Path
) -> None:
    root, url = place
    for name, where in (("here", ["--root", str(root)]), ("far", ["--server", url])):
        t6gps("render", "tiny", "1", "--step", "3", "--out", tmp_path / f"{name}.png", *where)
        t6gps("view", "tiny", "--pick", "best:2", "--evaluation", "0", "--out", tmp_path / f"{name}-rrd", *where)
        t6gps("policy", "export", "tiny", "--format", "c", "--out", tmp_path / f"{name}.h", *where)
        t6gps("fetch", "tiny", "--to", tmp_path / name, *where)
        assert run_digest.digests(tmp_path / name / "tiny") == tiny.digests
    assert (tmp_path / "here.png").read_bytes() == (tmp_path / "far.png").read_bytes()
    assert (tmp_path / "here.h").read_bytes() == (tmp_path / "far.h").read_bytes()
    here, far = ({path.name for path in (tmp_path / f"{name}-rrd").iterdir()} for name in ("here", "far"))
    assert here == far == {"tiny-evaluation-0-0.rrd", "tiny-evaluation-0-1.rrd"}


def test_figures_of_a_server_need_episodes_that_it_keeps(place: tuple[Path, str]) -> None:
    refused = t6gps("figures", "tiny", "--server", place[1], code=2).stderr
    assert "t6gps eval tiny" in refused and "--evaluation 0" in refused


def test_what_figures_are_drawn_from_is_the_same_through_a_server(place: tuple[Path, str]) -> None:
    root, url = place
    stored = []
    for server in (None, url):
        with door.opened(root, server) as there, there.at_hand("tiny") as run:
            stored.append(figures.gathered(there, run, there.table("tiny", "iterations"), 0, None))
    here, far = stored
    for name in ("iterations", "sampled", "models", "evaluation", "episodes", "frames"):
        assert getattr(far, name).to_pylist() == getattr(here, name).to_pylist(), name
        assert getattr(far, name).num_rows
    assert far.shown.frames.equals(here.shown.frames)
    assert (far.title, far.terrain) == (here.title, here.terrain)


@pytest.mark.parametrize("evaluation", [None, 0])
def test_an_episode_is_the_same_through_a_server(place: tuple[Path, str], evaluation: int | None) -> None:
    root, url = place
    stored = []
    for server in (None, url):
        with door.opened(root, server) as there:
            stored.append(there.episode("tiny", 1, evaluation))
    here, far = stored
    assert far.frames.equals(here.frames, check_metadata=True)
    assert far.summary.to_pylist() == here.summary.to_pylist()


@pytest.mark.parametrize("table", ["evaluations", "evaluation_episodes"])
def test_tables_of_evaluations_are_the_same_through_a_server(place: tuple[Path, str], table: str) -> None:
    root, url = place
    rows = []
    for server in (None, url):
        with door.opened(root, server) as there:
            rows.append(there.table("tiny", table).to_pylist())
    assert rows[0] == rows[1]
    assert rows[0]


def test_events_are_followed_alike_here_and_through_a_server(place: tuple[Path, str]) -> None:
    root, url = place
    followed = []
    for server in (None, url):
        with door.opened(root, server) as there:
            followed.append([event["event"] for event in islice(there.follow("paused"), 2)])
    assert followed == [["start", "paused"]] * 2


def test_tokens_are_made_and_revoked_through_a_server(place: tuple[Path, str]) -> None:
    root, url = place
    t6gps("token", "create", "other", "--server", url)
    assert {line.name for line in tokens.listed(root)} == {"me", "other"}
    t6gps("token", "revoke", "other", "--server", url)
    assert [line.name for line in tokens.listed(root)] == ["me"]

"""Laws of drives over HTTP: who may begin, steer and look, what is refused, and that nothing is left running."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from loopback import PATIENT, Server, listening

from t6gps.service import config as configuration
from t6gps.service.driving.drive import Patience
from t6gps.service.remote.client import Client
from t6gps.service.remote.messages import Scope, TokenRequest
from t6gps.service.remote.stream import Update
from t6gps.service.server import app, tokens
from t6gps.storage import catalog, schema
from t6gps.storage.delta import iterations
from t6gps.storage.errors import ConfigError, DataError, RunError, ServerError
from t6gps.storage.records import Episode, Learned, PolicySnapshot

PATIENCE, BRIEF = Patience(alone_s=120.0, look_s=0.05), Patience(alone_s=0.2, look_s=0.05)
LONG_S = 240


def policy(version: int) -> PolicySnapshot:
    rng = np.random.default_rng(version)
    layers = tuple(
        ((0.3 * rng.standard_normal((b, a))).astype(np.float32), np.zeros(b, np.float32))
        for a, b in pairwise([schema.OBSERVATION_N, 16, 24])
    )
    return PolicySnapshot(version, layers, offset_m=1.088, scale_m=0.2)


@pytest.fixture(scope="module")
def server(make_episode: Callable[..., Episode], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server of the run `walk`, which keeps a policy of version 1."""
    run = catalog.create(tmp_path_factory.mktemp("drives"), "walk", configuration.load("flat-quick").to_json())
    row: dict[str, object] = {**dict.fromkeys(schema.ITERATIONS.names, 0), "cost": 0.5}
    learned = Learned(row, [], schema.MODELS.empty_table(), [policy(1)])
    iterations.commit(run, 0, iter([make_episode(0, 0)]), learned)
    now = datetime.now(UTC)
    requests = {scope: TokenRequest(name=scope.value, scope=scope, days=1.0) for scope in Scope}
    texts = {scope: tokens.issue(run.path.parent, asked, now).token for scope, asked in requests.items()}
    made = Server("", run, texts)
    limits = replace(PATIENT, drives=PATIENCE)
    with listening(app.create(made.root, start=made.launch, now=made.now, limits=limits)) as made.url:
        yield made


@pytest.fixture
def client(server: Server) -> Iterator[Client]:
    """A client that may operate."""
    with server.client(Scope.OPERATE) as made:
        yield made


def until(frames: Iterator[Update], holds: Callable[[Update], bool]) -> Update:
    """The first update for which something holds."""
    return next(update for update in frames if holds(update))


def frame(start: int, time_s: float = 0.0) -> Callable[[Update], bool]:
    """True for a frame of that start from a time on; who is slow misses some."""
    return lambda update: update.kind == "frame" and update.data["start"] == start and update.data["time_s"] >= time_s


def children() -> set[int]:
    """Processes that simulate a drive, of this process."""
    return {
        int(path.name)
        for path in Path("/proc").glob("[0-9]*")
        if f"PPid:\t{os.getpid()}\n" in _read(path / "status") and "driving.process" in _read(path / "cmdline")
    }


def _read(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
        return ""


def test_a_drive_is_seen_steered_and_ended_and_two_race_on_one_ground(
    server: Server, client: Client, wait_until: Callable[..., None]
) -> None:
    drive = client.drives.begin([("walk", 1), ("walk", None)], 0)
    with server.client(Scope.READ) as reader:
        frames, others = client.drives.frames(drive), reader.drives.frames(drive)
        scene = until(frames, lambda update: update.kind == "scene").data
        assert next(others).kind == "scene", "who comes later sees it at once"
        assert [(robot["run"], robot["version"]) for robot in scene["robots"]] == [("walk", 1)] * 2
        assert scene["ground"] is None
        first, second = until(frames, frame(0, 1.0)).data["robots"]
        assert first == second, "the same policy on the same ground"
        assert len(first["nodes_m"]) == 36
        client.drives.steer(drive, by="tab", waypoint_m=[3.0, 1.0])
        assert until(others, lambda update: update.kind == "steered").data == {"by": "tab", "waypoint_m": [3.0, 1.0]}
        until(frames, lambda update: update.kind == "frame" and update.data["robots"][0]["waypoint_m"] == [3.0, 1.0])
        client.drives.steer(drive, push={"robot": 1, "impulse_n_s": [100.0, 0.0, 0.0]})
        until(
            frames,
            lambda update: (
                update.kind == "frame"
                and update.data["robots"][1]["com_m"][0] > update.data["robots"][0]["com_m"][0] + 0.2
            ),
        )
        client.drives.steer(drive, terrain_difficulty=0.8)
        rough = until(others, lambda update: update.kind == "scene").data
        assert len(rough["ground"]["heights_m"]) == 81**2
        until(frames, frame(1, 0.1))
        client.drives.steer(drive, paused=True)
        until(frames, lambda update: update.kind == "frame" and update.data["paused"])
        client.drives.steer(drive, friction=0.2)
        assert until(frames, lambda update: update.kind == "scene").data["friction"] == 0.2
        client.drives.end(drive)
        assert "'operate' has ended this drive" in until(frames, lambda update: update.kind == "end").data
        assert until(others, lambda update: update.kind == "end").data
    wait_until(lambda: not children(), LONG_S)
    with pytest.raises(ServerError, match="there is no drive"):
        client.drives.steer(drive, paused=False)


def test_a_third_drive_is_refused_and_who_may_operate_can_end_any(server: Server, client: Client) -> None:
    drives = [client.drives.begin([("walk", 1)], 0) for _ in range(2)]
    with pytest.raises(ServerError, match="2 drives are under way, by operate and operate"):
        client.drives.begin([("walk", 1)], 0)
    with server.client(Scope.ADMIN) as admin:
        for drive in drives:
            admin.drives.end(drive)
    client.drives.end(client.drives.begin([("walk", 1)], 0))


def test_a_drive_that_nobody_looks_at_ends(server: Server, wait_until: Callable[..., None]) -> None:
    limits = replace(PATIENT, drives=BRIEF)
    with (
        listening(app.create(server.root, start=server.launch, limits=limits)) as url,
        Client(url, server.tokens[Scope.OPERATE]) as client,
    ):
        drive = client.drives.begin([("walk", 1)], 0)

        def gone() -> bool:
            try:
                client.drives.steer(drive, paused=True)
            except ServerError as error:
                return "there is no drive" in str(error)
            return False

        wait_until(gone, LONG_S)
        wait_until(lambda: not children(), LONG_S)


def issued(server: Server, name: str, scope: Scope) -> Client:
    """A client with a token of its own."""
    asked = TokenRequest(name=name, scope=scope, days=1.0)
    return Client(server.url, tokens.issue(server.root, asked, datetime.now(UTC)).token)


def test_who_looks_does_so_with_a_token_that_holds_and_a_drive_ends_with_the_one_that_began_it(
    server: Server, client: Client
) -> None:
    with issued(server, "driver", Scope.OPERATE) as driver, issued(server, "guest", Scope.READ) as guest:
        drive = driver.drives.begin([("walk", 1)], 0)
        frames, seen = client.drives.frames(drive), guest.drives.frames(drive)
        until(seen, frame(0))
        driver.drives.steer(drive, paused=True)
        tokens.revoke(server.root, "guest")
        with pytest.raises(ServerError, match="token 'guest' is revoked or has expired; ask for another one"):
            until(seen, lambda update: update.kind == "end")
        with pytest.raises(ServerError, match="not known here"):
            next(guest.drives.frames(drive))
        driver.drives.steer(drive, paused=False)
        until(frames, frame(0, 0.2))
        tokens.revoke(server.root, "driver")
        assert "revoked or has expired" in until(frames, lambda update: update.kind == "end").data


def test_a_ground_that_ends_before_the_waypoint_is_refused(server: Server, client: Client) -> None:
    drive = client.drives.begin([("walk", 1)], 0)
    frames = client.drives.frames(drive)
    until(frames, frame(0))
    client.drives.steer(drive, waypoint_m=[100.0, 0.0])
    said = r"waypoint \(100\.0, 0\.0\) lies beyond that ground, which reaches 20 m.*before it changes, head for"
    with pytest.raises(ConfigError, match=said):
        client.drives.steer(drive, terrain_difficulty=0.5)
    client.drives.steer(drive, waypoint_m=[10.0, 0.0], terrain_difficulty=0.5)
    client.drives.steer(drive, terrain_difficulty=0.0)
    client.drives.steer(drive, waypoint_m=[100.0, 0.0])
    heard = [until(frames, lambda update: update.kind == "steered").data for _ in range(4)]
    assert [command.get("waypoint_m") for command in heard] == [[100.0, 0.0], [10.0, 0.0], None, [100.0, 0.0]]
    client.drives.end(drive)


def test_others_look_on_and_steer_nothing(server: Server, client: Client) -> None:
    drive = client.drives.begin([("walk", 1)], 0)
    with server.client(Scope.READ) as reader, server.client(Scope.ADMIN) as admin:
        with pytest.raises(ServerError, match="needs operate"):
            reader.drives.begin([("walk", 1)], 0)
        with pytest.raises(ServerError, match="needs operate"):
            reader.drives.steer(drive, paused=True)
        with pytest.raises(ServerError, match="'operate' began this drive and steers it"):
            admin.drives.steer(drive, paused=True)
        admin.drives.end(drive)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ({}, "a command changes something"),
        ({"friction": 1.6}, "friction"),
        ({"terrain_difficulty": -0.1}, "terrain_difficulty"),
        ({"waypoint_m": [1.0]}, "waypoint_m"),
        ({"waypoint_m": [1.0, float("nan")]}, "waypoint_m"),
        ({"push": {"robot": 0, "impulse_n_s": [201.0, 0.0, 0.0]}}, "impulse_n_s"),
        ({"push": {"robot": 0, "impulse_n_s": [0.0, float("inf"), 0.0]}}, "impulse_n_s"),
        ({"other": 1}, "other"),
    ],
)
def test_a_command_out_of_its_range_is_refused_before_it_is_sent_and_by_the_server(
    server: Server, client: Client, command: dict[str, object], said: str
) -> None:
    with pytest.raises(ServerError, match=said):
        client.drives.steer("0", **command)


def test_what_no_drive_can_do_is_refused_and_the_drive_goes_on(server: Server, client: Client) -> None:
    with pytest.raises(RunError, match="no run 'none'"):
        client.drives.begin([("none", 1)], 0)
    with pytest.raises(RunError, match="keeps no policy of version 9; kept: 1"):
        client.drives.begin([("walk", 9)], 0)
    with pytest.raises(DataError, match="has no episode 7"):
        client.drives.begin([("walk", 1)], 7)
    with pytest.raises(DataError, match="keeps no evaluation 3; kept: none"):
        client.drives.begin([("walk", 1)], 0, evaluation=3)
    drive = client.drives.begin([("walk", 1)], 0, terrain_difficulty=0.5)
    frames = client.drives.frames(drive)
    for command, said in (
        ({"push": {"robot": 1, "impulse_n_s": [1.0, 0.0, 0.0]}}, "robot 1 is none"),
        ({"waypoint_m": [21.0, 0.0]}, "beyond the ground, which reaches 20 m"),
    ):
        with pytest.raises(ConfigError, match=said):
            client.drives.steer(drive, **command)
    until(frames, frame(0, 0.5))
    client.drives.end(drive)


def test_a_server_that_stops_leaves_no_simulation(server: Server, wait_until: Callable[..., None]) -> None:
    with (
        listening(app.create(server.root, start=server.launch)) as url,
        Client(url, server.tokens[Scope.OPERATE]) as client,
    ):
        client.drives.begin([("walk", 1)], 0)
        wait_until(lambda: bool(children()), LONG_S)
    wait_until(lambda: not children(), LONG_S)

"""Laws of live updates: each comes once, also to who was cut off, and dead listeners hold up nobody."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterable, Iterator
from datetime import timedelta
from itertools import islice
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest
from loopback import Server, commit

from t6gps.service.remote import following
from t6gps.service.remote.client import Client
from t6gps.service.remote.connection import UnreachableError
from t6gps.service.remote.messages import Scope
from t6gps.service.remote.stream import START, Update, parsed
from t6gps.service.server import tokens
from t6gps.service.server.routes.access import STREAMS_N
from t6gps.service.steering.events import EventKind, EventLog, Happened
from t6gps.storage.errors import RunError, ServerError
from t6gps.storage.records import Episode


def test_who_was_cut_off_goes_on_after_the_last_id_and_hears_everything_once(
    server: Server, make_episode: Callable[..., Episode]
) -> None:
    log = EventLog(server.run.pool, largest_bytes=2000)
    log.write([Happened(EventKind.START, "0")], "sampling")
    heard: list[Update] = []

    def hear(number: int) -> None:
        """Connect, take so many updates, and be cut off."""
        heard.extend(islice(client.events("walk", heard[-1].id if heard else START), number))

    with server.client(Scope.READ) as client:
        hear(1)
        hear(2)
        commit(server.run, 2, make_episode)
        hear(1)
        for number in range(1, 40):  # more than a file takes
            log.write([Happened(EventKind.HANG, str(number))], "sampling")
            if number % 10 == 9:
                hear(10 if number > 9 else 9)
        commit(server.run, 3, make_episode)
        hear(1)
    rows = [update.data for update in heard if update.kind == "iteration"]
    assert [row["cost"] for row in rows] == [0.5, 1.5, 2.5, 3.5]
    told = [update.data for update in heard if update.kind == "pool"]
    assert [event["reason"] for event in told] == [str(number) for number in range(40)]
    assert len({update.id for update in heard}) == len(heard) == 44


class Breaking(httpx.BaseTransport):
    """A way to a server on which every stream of events breaks after its first event."""

    def __init__(self) -> None:
        self.way, self.ids = httpx.HTTPTransport(), list[str]()

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        answer = self.way.handle_request(request)
        self.ids.append(request.headers["Last-Event-ID"])
        return httpx.Response(answer.status_code, headers=answer.headers, stream=Cut(answer.stream))


class Cut(httpx.SyncByteStream):
    def __init__(self, whole: Iterable[bytes]) -> None:
        self.whole = whole

    def __iter__(self) -> Iterator[bytes]:
        for piece in self.whole:
            yield piece
            if b"event:" in piece:
                raise httpx.ReadError("the connection is cut")


def test_who_keeps_listening_hears_each_once_over_connections_that_break(server: Server) -> None:
    log = EventLog(server.run.pool)
    for number in range(3):
        log.write([Happened(EventKind.HANG, str(number))], "sampling")
    way = Breaking()
    with Client(server.url, server.tokens[Scope.READ], transport=way) as client:
        heard = list(islice(following.updates(client, "walk", look_s=0.01), 5))
    assert [update.id for update in heard] == ["0-1", "0-2", "0-3", "1-3", "2-3"]
    assert way.ids == [START, "0-1", "0-2", "0-3", "1-3"]


def test_a_server_that_stays_out_of_reach_is_one_error() -> None:
    with Client("http://127.0.0.1:1", "token") as client, pytest.raises(UnreachableError, match="cannot be reached"):
        next(following.updates(client, "walk", patience_s=0.05, look_s=0.01))


def test_listeners_share_what_was_seen_and_each_hears_it_all(
    server: Server, make_episode: Callable[..., Episode]
) -> None:
    with server.client(Scope.READ) as client:
        streams = [client.events("walk") for _ in range(3)]
        assert [[next(stream).id for _ in range(2)] for stream in streams] == [["1-0", "2-0"]] * 3
        commit(server.run, 2, make_episode)
        EventLog(server.run.pool).write([Happened(EventKind.START, "now")], "sampling")
        for stream in streams:
            assert {next(stream).kind, next(stream).kind} == {"iteration", "pool"}
            stream.close()


def test_a_stream_ends_with_its_token_also_where_nothing_happens(server: Server) -> None:
    with server.client(Scope.READ) as client, server.client(Scope.OPERATE) as other:
        streams = [client.events("walk"), following.updates(client, "walk"), other.events("walk")]
        assert [[next(stream).id for _ in range(2)] for stream in streams] == [["1-0", "2-0"]] * 3
        tokens.revoke(server.root, "read")
        for stream in streams[:2]:
            with pytest.raises(ServerError, match="token 'read' is revoked or has expired; ask for another one"):
                next(stream)
        with pytest.raises(ServerError, match="not known here; ask for another one"):
            next(client.events("walk"))
        server.later = timedelta(days=2)
        with pytest.raises(ServerError, match="token 'operate' is revoked or has expired"):
            next(streams[2])
        with pytest.raises(ServerError, match="token 'operate' expired at"):
            next(other.events("walk"))


def test_a_stream_ends_where_tokens_cannot_be_read_any_more(server: Server) -> None:
    with server.client(Scope.READ) as client:
        stream = client.events("walk")
        assert [next(stream).id for _ in range(2)] == ["1-0", "2-0"]
        book = server.root / tokens.FOLDER / "tokens.json"
        book.chmod(0o644)
        book.touch()
        with pytest.raises(ServerError, match="the server cannot read its tokens; see its log"):
            next(stream)


def test_a_stream_of_a_run_that_does_not_exist_is_refused(server: Server) -> None:
    with server.client(Scope.READ) as client, pytest.raises(RunError, match="no run 'none'"):
        next(client.events("none"))


@pytest.mark.parametrize("last", ["-2", "x", "1", "1-", "1-x", "9" * 30 + "-0"])
def test_an_id_that_was_never_given_is_refused(server: Server, last: str) -> None:
    with server.http(Scope.READ) as http:
        assert http.get("/v1/runs/walk/events", headers={"Last-Event-ID": last}).status_code == 422


def listener(server: Server, path: str) -> socket.socket:
    """A client that asks and takes nothing of the answer."""
    place = urlsplit(server.url)
    asking = socket.socket()
    asking.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
    asking.connect((place.hostname, place.port))
    head = f"GET {path} HTTP/1.1\r\nHost: {place.netloc}\r\nAuthorization: Bearer {server.tokens[Scope.READ]}\r\n\r\n"
    asking.sendall(head.encode())
    return asking


def test_listeners_that_take_nothing_or_are_dead_hold_up_nobody(
    server: Server, wait_until: Callable[..., None]
) -> None:
    alive = [listener(server, "/v1/runs/walk/events") for _ in range(10)]
    with server.client(Scope.READ) as client:
        for _ in range(STREAMS_N):
            dead = listener(server, "/v1/runs/walk/events")
            assert dead.recv(12) in (b"HTTP/1.1 200", b"HTTP/1.1 503")
            dead.close()
            assert client.versions("walk") == []

        def heard() -> bool:
            try:
                return next(client.events("walk")).id == "1-0"
            except ServerError:  # all slots are taken until those that went are noticed
                return False

        wait_until(heard, 240)
    for asking in alive:
        asking.close()


def test_a_client_that_takes_nothing_is_dropped(serve: Callable[..., Server], wait_until: Callable[..., None]) -> None:
    server = serve(stalled_s=3.0)
    (server.run.figures / "large.png").write_bytes(b"\0" * 2**25)
    slow = listener(server, "/v1/runs/walk/figures/large.png")
    ports = urlsplit(server.url).port, slow.getsockname()[1]
    assert connected(*ports)
    assert slow.recv(12) == b"HTTP/1.1 200"
    wait_until(lambda: not connected(*ports), 240)
    slow.close()


def connected(port: int, other: int) -> bool:
    """True while the kernel holds a connection from `port` of this machine to `other`."""
    lines = [line.split() for line in Path("/proc/net/tcp").read_text(encoding="ascii").splitlines()[1:]]
    return (port, other) in {tuple(int(end.rpartition(":")[2], 16) for end in line[1:3]) for line in lines}


def test_events_are_read_as_they_were_written() -> None:
    lines = [
        ": alive",
        "",
        "event: status",
        'data: {"state": 1}',
        "",
        "event: iteration",
        "id: 7-2",
        "data: {}",
        "",
    ]
    assert list(parsed(lines)) == [Update("status", {"state": 1}), Update("iteration", {}, "7-2")]
    assert not list(parsed(["event: status", "data: {}"])), "an event that was cut off is none"

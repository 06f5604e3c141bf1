"""The lines between supervisor and workers: whole messages in their order, nobody else's, and an end for both sides."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from t6gps.service.ray_backend import channel
from t6gps.service.ray_backend.channel import Address, Cut, Hub

DEADLINE_S = 10.0


@pytest.fixture
def hub() -> Iterator[Hub]:
    with closing(Hub("127.0.0.1")) as hub:
        yield hub


def connected(hub: Hub, address: Address) -> socket.socket:
    """A worker's end that the hub has heard of."""
    line = channel.connect(address)
    channel.send(line, "here")
    assert hub.hear(DEADLINE_S) == [(address.number, "here", pa.py_buffer(b""))]
    return line


def test_messages_arrive_whole_and_in_order_though_nobody_listens_meanwhile(hub: Hub) -> None:
    rng = np.random.default_rng(0)
    pieces = [rng.bytes(n) for n in (0, 1, 20_000_000, 300_000, 0)]  # more than a socket's buffers hold
    with connected(hub, hub.open()) as line:
        for number, piece in enumerate(pieces):
            channel.send(line, number, pa.py_buffer(piece))
        found: list[tuple[int, object, pa.Buffer]] = []
        while len(found) < len(pieces):
            found += hub.hear(DEADLINE_S)
    assert [(head, memory.to_pybytes()) for _, head, memory in found] == list(enumerate(pieces))


def test_each_worker_hears_what_is_meant_for_it(hub: Hub) -> None:
    addresses = [hub.open() for _ in range(3)]
    lines = [connected(hub, address) for address in addresses]
    for address in reversed(addresses):
        hub.send(address.number, {"for": address.number})
    for address, line in zip(addresses, lines, strict=True):
        with line:
            assert channel.receive(line) == ({"for": address.number}, pa.py_buffer(b""))


@pytest.mark.parametrize("wrong", ["secret", "number", "taken", "cut"])
def test_a_stranger_is_not_heard(hub: Hub, wrong: str) -> None:
    address = hub.open()
    with connected(hub, address) as line:
        stranger = {
            "secret": replace(hub.open(), secret=bytes(32)),
            "number": replace(address, number=99),
            "taken": address,
            "cut": hub.open(),
        }[wrong]
        if wrong == "cut":
            hub.cut(stranger.number)
        with channel.connect(stranger) as other, pytest.raises((EOFError, OSError)):
            channel.send(other, "let me in")
            channel.receive(other)
        channel.send(line, "still here")
        assert [head for _, head, _ in hub.hear(DEADLINE_S)] == ["still here"]


def test_the_secret_does_not_stand_in_what_is_printed(hub: Hub) -> None:
    assert "secret" not in repr(hub.open())


def test_a_cut_ends_both_sides_and_what_is_sent_into_it_is_lost(hub: Hub) -> None:
    address = hub.open()
    with connected(hub, address) as line:
        line.shutdown(socket.SHUT_RDWR)
        hub.send(address.number, "lost")
        assert hub.hear(DEADLINE_S) == [(address.number, Cut(), channel.NOTHING)]
        hub.cut(address.number)
    with connected(hub, address := hub.open()) as line:
        hub.cut(address.number)
        assert hub.hear(DEADLINE_S) == [(address.number, Cut(), channel.NOTHING)]
        with pytest.raises((EOFError, OSError)):
            channel.receive(line)


def test_a_message_that_breaks_off_is_not_heard(hub: Hub) -> None:
    address = hub.open()
    with connected(hub, address) as line:
        line.sendall(channel.LENGTHS.pack(5, 1000) + b"half")
    assert hub.hear(DEADLINE_S) == [(address.number, Cut(), channel.NOTHING)]


def test_a_closed_hub_leaves_no_thread_behind(wait_until: Callable[..., None]) -> None:
    hub = Hub("127.0.0.1")
    line = connected(hub, hub.open())
    unused = hub.open()
    hub.close()
    wait_until(lambda: not any(each.name.startswith("t6gps") for each in threading.enumerate()), DEADLINE_S)
    with line, pytest.raises((EOFError, OSError)):
        channel.receive(line)
    with pytest.raises(OSError):
        channel.connect(unused)

"""Messages between the supervisor and its workers: plans go out, episodes come back, over TCP and past Ray.

Ray starts the processes, places them and says how they ended. A message is a pickled head and a piece of memory, after
the lengths of both. Whoever connects must first show the secret that the workers get through Ray.
"""

from __future__ import annotations

import hmac
import logging
import pickle
import secrets
import socket
import struct
from collections.abc import Generator
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from selectors import EVENT_READ, DefaultSelector
from threading import Lock, Thread
from typing import Any

import pyarrow as pa

LENGTHS = struct.Struct("<QQ")
"""Of the head and of the memory that follows it."""
INTRODUCTION = struct.Struct("<32sQ")
"""Secret and number."""
BACKLOG_N = 1024
"""So many may connect at once."""
NOTHING = pa.py_buffer(b"")
"""The memory of a message that has none."""
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Address:
    """Where a worker reaches its supervisor, and as whom."""

    host: str
    port: int
    number: int
    secret: bytes = field(repr=False)

    @property
    def introduction(self) -> bytes:
        """The first that a worker sends."""
        return INTRODUCTION.pack(self.secret, self.number)


def listen(host: str) -> socket.socket:
    """A server on a free port of a host."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    return socket.create_server((host, 0), family=family, backlog=BACKLOG_N)


def connect(address: Address, deadline_s: float | None = None) -> socket.socket:
    """The end of a line of whoever connects. OSError when nobody listens there.

    deadline_s    how long anything that is done with the line may take (s)
    """
    line = socket.create_connection((address.host, address.port), deadline_s)
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    line.sendall(address.introduction)
    return line


def send(line: socket.socket, head: Any, memory: pa.Buffer = NOTHING) -> None:
    """Send a message. OSError when the line is cut."""
    line.sendall(headed(head, memory))
    if memory.size:
        line.sendall(memory)


def headed(head: Any, memory: pa.Buffer) -> bytes:
    """What goes before the memory: both lengths, and the head."""
    pickled = pickle.dumps(head)
    return LENGTHS.pack(len(pickled), memory.size) + pickled


def receive(line: socket.socket) -> tuple[Any, pa.Buffer]:
    """Wait for a message. EOFError or OSError when the line is cut."""
    head_n, memory_n = LENGTHS.unpack(_exactly(line, LENGTHS.size))
    return pickle.loads(_exactly(line, head_n)), _exactly(line, memory_n) if memory_n else NOTHING


def _exactly(line: socket.socket, n: int) -> pa.Buffer:
    """The next n bytes."""
    buffer = pa.allocate_buffer(n)
    rest = memoryview(buffer).cast("B")
    while rest:
        received_n = line.recv_into(rest, 0, socket.MSG_WAITALL)
        if not received_n:
            raise EOFError("the line between supervisor and worker is cut")
        rest = rest[received_n:]
    return buffer


def introduced(line: socket.socket, secret: bytes) -> bool:
    """Hear the first that somebody says who connects; True when it knows the secret."""
    found, _ = INTRODUCTION.unpack(_exactly(line, INTRODUCTION.size))
    return hmac.compare_digest(found, secret)


@dataclass(frozen=True)
class Cut:
    """In the place of a message: the line has ended."""


class Incoming:
    """The bytes of a line, cut into the pieces that its reader wants: a generator that yields their lengths."""

    def __init__(self, line: socket.socket, reader: Generator[int, pa.Buffer, None]) -> None:
        self._line, self._reader = line, reader
        self._want(next(reader))

    def _want(self, n: int) -> None:
        self._piece = pa.allocate_buffer(n)
        self._rest = memoryview(self._piece).cast("B")

    def advance(self) -> None:
        """Take what has come. EOFError or OSError when the line is cut, StopIteration when its reader is done."""
        received_n = self._line.recv_into(self._rest)
        if not received_n:
            raise EOFError("the line is cut")
        self._rest = self._rest[received_n:]
        if not self._rest:
            self._want(self._reader.send(self._piece))

    def close(self) -> None:
        """Let the reader know that nothing follows."""
        self._reader.close()


class Hub:
    """The supervisor's ends of all lines. One thread reads them, so that nobody waits for a line that stalls."""

    def __init__(self, host: str) -> None:
        self._server = listen(host)
        self.host, self._secret = host, secrets.token_bytes(32)
        self._lines: dict[int, socket.socket | None] = {}
        self._heard: SimpleQueue[tuple[int, Any, pa.Buffer]] = SimpleQueue()
        self._opened_n, self._closed, self._lock = 0, False, Lock()
        Thread(target=self._read, name="t6gps-hub", daemon=True).start()

    def open(self) -> Address:
        """Expect one more worker; where it shall connect."""
        self._opened_n += 1
        self._lines[self._opened_n] = None
        return Address(self.host, self._server.getsockname()[1], self._opened_n, self._secret)

    def send(self, number: int, head: Any) -> None:
        """Send a message to a worker that was heard of. It is lost if the line is cut: Ray tells how it ended."""
        line = self._lines[number]
        assert line is not None, "a worker must connect before anything is sent to it"
        with suppress(OSError):
            send(line, head)

    def hear(self, wait_s: float) -> list[tuple[int, Any, pa.Buffer]]:
        """Every message since the last call, by the number of its worker, and a `Cut` after the last of a line.

        Waits up to `wait_s` for a first one.
        """
        found = []
        with suppress(Empty):
            found.append(self._heard.get(wait_s > 0, wait_s))
            while True:
                found.append(self._heard.get_nowait())
        return found

    def cut(self, number: int) -> None:
        """End a line, whether the worker has connected or not."""
        with self._lock:
            line = self._lines.pop(number, None)
        if line is not None:
            _shut(line)

    def close(self) -> None:
        """End every line, and expect nobody."""
        for number in list(self._lines):
            self.cut(number)
        self._closed = True
        _shut(self._server)

    def _read(self) -> None:
        """What the thread does until the server is shut."""
        with DefaultSelector() as selector:
            selector.register(self._server, EVENT_READ)
            while not self._closed:
                for key, _ in selector.select():
                    try:
                        if key.data is not None:
                            key.data.advance()
                        elif not self._closed:
                            line, _ = self._server.accept()
                            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                            selector.register(line, EVENT_READ, Incoming(line, self._messages(line)))
                    except Exception as error:  # whatever is wrong with a line, the others are read
                        _log.info("a line to a worker has ended: %r", error)
                        if key.data is not None:
                            key.data.close()
                            selector.unregister(key.fileobj)
                            key.fileobj.close()  # type: ignore[union-attr]
            for key in selector.get_map().values():
                key.fileobj.close()  # type: ignore[union-attr]

    def _messages(self, line: socket.socket) -> Generator[int, pa.Buffer, None]:
        """The reader of a line."""
        secret, number = INTRODUCTION.unpack((yield INTRODUCTION.size))
        with self._lock:
            if not hmac.compare_digest(secret, self._secret) or self._lines.get(number, line) is not None:
                _log.warning("somebody unknown tried to connect as a worker, from %s", line.getpeername())
                return
            self._lines[number] = line
        try:
            while True:
                head_n, memory_n = LENGTHS.unpack((yield LENGTHS.size))
                head = pickle.loads((yield head_n))
                self._heard.put((number, head, (yield memory_n) if memory_n else NOTHING))
        finally:
            self._heard.put((number, Cut(), NOTHING))


def _shut(end: socket.socket) -> None:
    """Wake whoever waits at a socket; it is closed there."""
    with suppress(OSError):  # the other end was faster
        end.shutdown(socket.SHUT_RDWR)

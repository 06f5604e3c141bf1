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
from contextlib import suppress
from dataclasses import dataclass, field
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import Any

import pyarrow as pa

LENGTHS = struct.Struct("<QQ")
"""Of the head and of the memory that follows it."""
INTRODUCTION = struct.Struct("<32sQ")
"""Secret and number."""
INTRODUCE_DEADLINE_S = 10.0
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


def connect(address: Address) -> socket.socket:
    """The worker's end of its line. OSError when nobody listens there."""
    line = socket.create_connection((address.host, address.port))
    line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    line.sendall(INTRODUCTION.pack(address.secret, address.number))
    return line


def send(line: socket.socket, head: Any, memory: pa.Buffer = NOTHING) -> None:
    """Send a message. OSError when the line is cut."""
    pickled = pickle.dumps(head)
    line.sendall(LENGTHS.pack(len(pickled), memory.size) + pickled)
    if memory.size:
        line.sendall(memory)


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


class Hub:
    """The supervisor's ends of all lines. A thread reads each, so that nobody waits for a line that stalls."""

    def __init__(self, host: str) -> None:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._server = socket.create_server((host, 0), family=family)
        self._host, self._secret = host, secrets.token_bytes(32)
        self._lines: dict[int, socket.socket | None] = {}
        self._heard: SimpleQueue[tuple[int, Any, pa.Buffer]] = SimpleQueue()
        self._opened_n, self._lock = 0, Lock()
        Thread(target=self._welcome, name="t6gps-hub", daemon=True).start()

    def open(self) -> Address:
        """Expect one more worker; where it shall connect."""
        self._opened_n += 1
        self._lines[self._opened_n] = None
        return Address(self._host, self._server.getsockname()[1], self._opened_n, self._secret)

    def send(self, number: int, head: Any) -> None:
        """Send a message to a worker that was heard of. It is lost if the line is cut: Ray tells how it ended."""
        line = self._lines[number]
        assert line is not None, "a worker must connect before anything is sent to it"
        with suppress(OSError):
            send(line, head)

    def hear(self, wait_s: float) -> list[tuple[int, Any, pa.Buffer]]:
        """Every message since the last call, by the number of its worker; waits up to `wait_s` for a first one."""
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
        _shut(self._server)

    def _welcome(self) -> None:
        while True:
            try:
                line, _ = self._server.accept()
            except OSError:  # it was shut
                self._server.close()
                return
            Thread(target=self._read, args=(line,), name="t6gps-line", daemon=True).start()

    def _read(self, line: socket.socket) -> None:
        with line:
            try:
                number = self._introduced(line)
                while number is not None:
                    self._heard.put((number, *receive(line)))
            except (OSError, EOFError) as error:
                _log.info("a line to a worker has ended: %s", error)

    def _introduced(self, line: socket.socket) -> int | None:
        """The number of the worker that has connected; None for a stranger."""
        line.settimeout(INTRODUCE_DEADLINE_S)
        secret, number = INTRODUCTION.unpack(_exactly(line, INTRODUCTION.size))
        line.settimeout(None)
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        with self._lock:
            if hmac.compare_digest(secret, self._secret) and self._lines.get(number, line) is None:
                self._lines[number] = line
                return int(number)
        _log.warning("somebody unknown tried to connect as a worker, from %s", line.getpeername())
        return None


def _shut(end: socket.socket) -> None:
    """Wake whoever waits at a socket; it is closed there."""
    with suppress(OSError):  # the other end was faster
        end.shutdown(socket.SHUT_RDWR)

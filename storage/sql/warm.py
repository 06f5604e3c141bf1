"""The owner's side of `nursery`: it is started with the first question of this process, kept for the next, and ends
with this process.
"""

from __future__ import annotations

import atexit
import os
import socket
import subprocess
import sys
import tempfile
import threading
from typing import BinaryIO, final

from t6gps.storage.errors import QueryError
from t6gps.storage.objects import store
from t6gps.storage.sql import nursery

STOP_S = 5.0
"""A nursery that does not end by itself for so long is killed."""
_WORDS_N = 2000


@final
class Nursery:
    """A running nursery. Asked by many threads at once, it starts a child for each."""

    def __init__(self) -> None:
        self._words, self._said = tempfile.TemporaryFile(), ""  # noqa: SIM115 # closed with the process
        self._closing = threading.Lock()
        self._line, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", nursery.__name__, str(other.fileno())],
                pass_fds=[other.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._words,
                cwd="/",
                env={**_without_keys(), **nursery.ENVIRONMENT},
            )
        atexit.register(self.close)

    def close(self) -> None:
        """End it, and what it has started."""
        atexit.unregister(self.close)
        self._line.close()
        with self._closing:
            try:
                self._process.wait(STOP_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            if not self._words.closed:
                self._words.seek(0)
                self._said = self._words.read(_WORDS_N).decode(errors="replace").strip()
                self._words.close()

    @property
    def pid(self) -> int:
        """Its process."""
        return self._process.pid

    def is_alive(self) -> bool:
        """True until it has ended."""
        return self._process.poll() is None

    def answered(self, question: BinaryIO, result: BinaryIO, words: BinaryIO, timeout_s: float) -> int | None:
        """Let a child read a question, and write its result and its words; its exit status.

        None where it was killed after so many seconds. QueryError where the nursery itself has ended.
        """
        here, there = socket.socketpair()
        with here:
            with there:
                files = [question.fileno(), result.fileno(), words.fileno(), there.fileno()]
                try:
                    socket.send_fds(self._line, [b"?"], files)
                except OSError as error:
                    raise self._ended() from error
            here.settimeout(max(timeout_s, 1e-3))  # zero would not wait at all
            try:
                status = here.recv(nursery.STATUS_BYTES_N)
            except TimeoutError:
                return None
            except ConnectionResetError:
                status = b""
        if not status:
            raise self._ended()
        return int.from_bytes(status, signed=True)

    def _ended(self) -> QueryError:
        self.close()
        return QueryError(
            "the process that starts queries has ended, most likely for want of memory; ask again, with more memory "
            f"free; its last words: {self._said.splitlines()[-1] if self._said else 'none'}"
        )


def _without_keys() -> dict[str, str]:
    """The variables of this process but for those of object stores, which questions about them bring along."""
    return {name: value for name, value in os.environ.items() if name not in store.variables()}


_starting = threading.Lock()
_running: list[Nursery] = []


def running() -> Nursery:
    """The nursery of this process; it is started where there is none, or where it has ended."""
    with _starting:
        if _running and not _running[0].is_alive():
            _running.pop().close()
        if not _running:
            _running.append(Nursery())
        return _running[0]

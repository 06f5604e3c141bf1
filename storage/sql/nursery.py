"""The process that forks those of queries: it has loaded what they need, so that each starts in milliseconds.

    python -m t6gps.storage.sql.nursery FD

Each message on the socket FD brings four open files: a question, the file for its result, that for words, and the
asker's line. A child answers (`sandbox`); its exit status, as an integer of four bytes, goes to the line. A line that
is closed before that ends the child. When the other end of FD is closed, because its owner has ended in whatever way,
all children are killed, and this process ends. It has one thread, since no other would live on in a child.
"""

from __future__ import annotations

import gc
import os
import selectors
import signal
import socket
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from t6gps.storage.sql import sandbox
from t6gps.storage.sql.sandbox import REFUSED

ENVIRONMENT = {
    # Allocators that reserve address space per thread would eat a child's bound before its query starts.
    "ARROW_DEFAULT_MEMORY_POOL": "system",
    "MALLOC_ARENA_MAX": "2",
    # Threads that wait in libraries would not be there in a child.
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "PYTHONIOENCODING": "utf-8",  # of a refusal, whatever the locale
}
STATUS_BYTES_N, FILES_N = 4, 4
BROKEN = 1
"""The exit status of a child with a fault of ours."""


@dataclass(frozen=True)
class _Child:
    """A query's process, by its id and its handle, and the line of who asked."""

    pid: int
    handle: int
    line: socket.socket


def main(owner: socket.socket) -> None:
    """Start children for the owner until it has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the owner decides what Ctrl-C ends
    gc.collect()
    gc.freeze()  # else each child would copy what the collector touches
    with selectors.DefaultSelector() as ready:
        ready.register(owner, selectors.EVENT_READ)
        try:
            _serve(ready, owner)
        finally:
            _kill_all(ready)


def _serve(ready: selectors.BaseSelector, owner: socket.socket) -> None:
    while True:
        for key, _ in ready.select():
            child: _Child | None = key.data
            if child is None:
                content, files, _, _ = socket.recv_fds(owner, 1, FILES_N)
                if not content:
                    return
                _start(ready, files)
            elif ready.get_map().get(key.fd) is not key:  # its other event came first
                continue
            elif key.fileobj is child.line:  # who asked has gone
                ready.unregister(child.line)
                signal.pidfd_send_signal(child.handle, signal.SIGKILL)
            else:
                _report(ready, child)


def _start(ready: selectors.BaseSelector, files: Sequence[int]) -> None:
    *own, line = files
    try:
        pid = os.fork()
    except OSError as error:  # no room for another process: the others go on
        os.write(own[2], f"no process can be started for the query: {error.strerror}; ask again later".encode())
        with socket.socket(fileno=line) as asker, suppress(BrokenPipeError, ConnectionResetError):
            asker.send(REFUSED.to_bytes(STATUS_BYTES_N))
        for file in own:
            os.close(file)
        return
    if not pid:
        os._exit(_answered(own))
    for file in own:
        os.close(file)
    child = _Child(pid, os.pidfd_open(pid), socket.socket(fileno=line))
    ready.register(child.line, selectors.EVENT_READ, child)
    ready.register(child.handle, selectors.EVENT_READ, child)


def _answered(files: Sequence[int]) -> int:
    """In the child: answer the question, with no other file open."""
    try:
        for place, file in enumerate(files):
            os.dup2(file, place)
        for file in [int(path.name) for path in Path("/proc/self/fd").iterdir()]:
            if file >= len(files):
                with suppress(OSError):  # that of the listing itself
                    os.close(file)
        return sandbox.answer()
    except BaseException:
        with open(2, "w", encoding="utf-8") as words:
            traceback.print_exc(file=words)
        return BROKEN


def _report(ready: selectors.BaseSelector, child: _Child) -> None:
    """Tell who asked, if somebody still listens, how a child has ended."""
    _, status = os.waitpid(child.pid, 0)
    with suppress(KeyError):
        ready.unregister(child.line)
    ready.unregister(child.handle)
    with suppress(BrokenPipeError, ConnectionResetError):
        child.line.send(os.waitstatus_to_exitcode(status).to_bytes(STATUS_BYTES_N, signed=True))
    child.line.close()
    os.close(child.handle)


def _kill_all(ready: selectors.BaseSelector) -> None:
    for handle in {key.data.handle for key in ready.get_map().values() if key.data is not None}:
        signal.pidfd_send_signal(handle, signal.SIGKILL)


if __name__ == "__main__":
    with socket.socket(fileno=int(sys.argv[1])) as given:
        main(given)

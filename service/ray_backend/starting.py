"""Starting Ray so that the start can be given up: when it takes too long, and when a signal comes.

Ray starts and joins in C, where Python hears no signal. So it does that in a thread of its own, and the caller waits.
The thread stays until the end: the kernel ends Ray's processes with the thread that started them.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import ray

from t6gps.service import caller, logs
from t6gps.service.ray_backend import private, processes

DEADLINE_S = 45.0
"""A start takes three seconds, on a busy machine twenty."""
GONE_DEADLINE_S = 5.0
"""For processes that were killed."""


@contextmanager
def started(options: dict[str, Any], deadline_s: float = DEADLINE_S) -> Iterator[None]:
    """Ray as `ray.init` starts or joins it with `options`, until the end; called while nothing is connected.

    TimeoutError when that takes longer than `deadline_s`; else what `ray.init` raises. A start that is given up, also
    by KeyboardInterrupt, goes on in its thread, which undoes it as soon as Ray answers. It ends with this process.
    """
    _wait_for_the_last(deadline_s)
    connected: Future[None] = Future()
    over = threading.Event()
    thread = threading.Thread(target=_hold, args=(options, connected, over), name=caller.STARTING, daemon=True)
    thread.start()
    try:
        connected.result(deadline_s)
    except BaseException as error:
        over.set()
        if isinstance(error, TimeoutError) and not connected.done():
            raise TimeoutError(f"no answer within {deadline_s:.0f} s") from None
        raise
    try:
        yield
    finally:
        with caller.untouched():
            over.set()
            thread.join()


def _wait_for_the_last(deadline_s: float) -> None:
    """Let a start that was given up end first. TimeoutError when it does not."""
    for thread in threading.enumerate():
        if thread.name == caller.STARTING:
            thread.join(deadline_s)
            if thread.is_alive():
                raise TimeoutError(f"no answer within {deadline_s:.0f} s to an earlier start of this process")


def _hold(options: dict[str, Any], connected: Future[None], over: threading.Event) -> None:
    """What the thread does: Ray is connected until `over`."""
    before = set(processes.descendants(os.getpid()))
    private.read_authentication()
    try:
        ray.init(log_to_driver=False, logging_level=logging.ERROR, **options)
        logs.adopt("ray")
    except BaseException as error:  # it is raised where somebody waits
        _end_what_is_left(before)
        connected.set_exception(error)
        return
    connected.set_result(None)
    over.wait()
    ray.shutdown()
    private.read_authentication()


def _end_what_is_left(before: set[int]) -> None:
    """End processes that Ray has started in vain; other children of this process are left alone."""
    folder = str(Path(ray.__file__).parent)
    deadline = time.monotonic() + GONE_DEADLINE_S
    while time.monotonic() < deadline:
        new = set(processes.descendants(os.getpid())) - before
        left = [pid for pid in new if folder in (command := processes.command(pid)) or "ray::" in command]
        if not left:
            return
        processes.end(left)
        time.sleep(0.02)

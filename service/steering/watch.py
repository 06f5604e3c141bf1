"""Heeding `t6gps stop`: a thread looks for the request, and lets KeyboardInterrupt come to whoever runs the run.

So a stop is heeded wherever Ctrl-C is: while Ray starts, while workers sample, while tables are written, and in a run
without workers of its own.
"""

from __future__ import annotations

import ctypes
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

from t6gps.service import caller
from t6gps.service.steering.requests import Inbox, What
from t6gps.storage.catalog import Run

LOOK_S = 0.25


@contextmanager
def heeding(run: Run) -> Iterator[None]:
    """Raise KeyboardInterrupt here, once, when somebody asks the run to stop meanwhile."""
    over, deciding = threading.Event(), threading.Lock()
    thread = threading.Thread(target=_watch, args=(run, _interrupter(), over, deciding), name="t6gps stop", daemon=True)
    thread.start()
    try:
        yield
    finally:
        with deciding:
            over.set()
        thread.join()


def _interrupter() -> Callable[[], object]:
    """What interrupts this thread: a signal that means KeyboardInterrupt here, else the exception itself.

    Python gives signals to the main thread alone; there they also end what waits in the system.
    """
    thread = threading.get_ident()
    stops = [number for number in caller.STOPS if signal.getsignal(number) is signal.default_int_handler]
    if stops and threading.current_thread() is threading.main_thread():
        return partial(signal.pthread_kill, thread, stops[0])
    exception = ctypes.py_object(KeyboardInterrupt)
    return partial(ctypes.pythonapi.PyThreadState_SetAsyncExc, ctypes.c_ulong(thread), exception)


def _watch(run: Run, interrupt: Callable[[], object], over: threading.Event, deciding: threading.Lock) -> None:
    inbox = Inbox(run)
    while not over.wait(LOOK_S):
        request = inbox.new()
        if request is not None and request.what is What.STOP:
            with deciding:
                if not over.is_set():
                    interrupt()
            return

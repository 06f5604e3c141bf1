"""What libraries change in the process that calls this package, put back: environment variables, signal handlers.

Ray sets variables when it is imported and when it connects, and a handler for SIGTERM each time. They belong to the
program that uses this package. Handlers can be set in the main thread alone, by Ray as well.
"""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager

STOPS = (signal.SIGINT, signal.SIGTERM)
STARTING = "t6gps starts Ray"
"""Name of the thread that does, and stays until Ray is left (`ray_backend.starting`)."""


@contextmanager
def untouched() -> Iterator[None]:
    """Put the environment and the handlers of STOPS back at the end."""
    environment = dict(os.environ)
    with _kept_handlers():
        try:
            yield
        finally:
            for name in os.environ.keys() - environment.keys():
                del os.environ[name]
            os.environ.update(environment)


@contextmanager
def undisturbed() -> Iterator[None]:
    """Ignore STOPS meanwhile: everything is being stopped, and nothing of it must be left behind."""
    with _kept_handlers():
        if threading.current_thread() is threading.main_thread():
            for number in STOPS:
                signal.signal(number, signal.SIG_IGN)
        yield


@contextmanager
def _kept_handlers() -> Iterator[None]:
    in_main = threading.current_thread() is threading.main_thread()
    handlers = {number: signal.getsignal(number) for number in STOPS} if in_main else {}
    try:
        yield
    finally:
        for number, handler in handlers.items():
            if handler is not None:  # it was set in C, and Python cannot set it again
                signal.signal(number, handler)

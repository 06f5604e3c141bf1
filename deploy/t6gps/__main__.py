"""The program `t6gps`: it sets what a process of its own may set, then hands over to the command line."""

import os
import signal
import sys
import threading
from typing import NoReturn


def use_one_thread() -> None:
    """Let numerical libraries that are yet to be loaded, also in children, start with one thread each.

    Parallelism comes from processes.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def leave(code: int) -> NoReturn:
    """End this process; at once, with all that it started, when a start of Ray was given up: its thread waits in C."""
    from t6gps.service.caller import STARTING

    if any(thread.name == STARTING for thread in threading.enumerate()):
        from t6gps.service.ray_backend import processes

        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        processes.end(processes.descendants(os.getpid()))
        os._exit(code)
    sys.exit(code)


def main() -> None:
    """Entry point of the command. SIGTERM stops it as Ctrl-C does; both end it at once while it is being loaded."""
    from t6gps.service.cli import streams

    streams.prepare()
    use_one_thread()
    interrupt = signal.getsignal(signal.SIGINT)
    if interrupt is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from t6gps.service.cli.guide import completion

    if completion.asked():
        completion.answer()
    from t6gps.service.cli.main import main as command_line  # it loads numpy

    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        command_line()
    except SystemExit as ended:
        leave(ended.code if isinstance(ended.code, int) else ended.code is not None)


if __name__ == "__main__":
    if not sys.flags.safe_path:
        del sys.path[0]  # the working folder, where any file may lie: `python -m` puts it first
    main()

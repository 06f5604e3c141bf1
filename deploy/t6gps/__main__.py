"""The program `t6gps`: it sets what a process of its own may set, then hands over to the command line."""

import os
import signal


def use_one_thread() -> None:
    """Let numerical libraries that are yet to be loaded, also in children, start with one thread each.

    Parallelism comes from processes.
    """
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"


def main() -> None:
    """Entry point of the command. SIGTERM stops it as Ctrl-C does."""
    from t6gps.service.cli import streams

    streams.prepare()
    use_one_thread()
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    from t6gps.service.cli.main import main as command_line  # it loads numpy

    command_line()


if __name__ == "__main__":
    main()

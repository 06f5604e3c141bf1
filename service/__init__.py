"""The service: configuration, executors, the training loop and the command line.

What must be set before numpy and ray are loaded stands here. Every process computes with one thread: parallelism comes
from processes, and results do not depend on how a library splits its sums. An embedded Ray talks only to processes that
know the token of this one.
"""

import os
import secrets

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"
if "RAY_ADDRESS" not in os.environ:
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
    # Ray would run the workers at the lowest priority but four: on a busy machine they hardly start.
    os.environ.setdefault("RAY_worker_niceness", "0")
    os.environ.setdefault("RAY_task_events_report_interval_ms", "0")  # nobody asks for the history of calls
    os.environ.setdefault("RAY_memory_monitor_refresh_ms", "1000")  # four times a second costs a thousandth of a core
    # Processes that fit models wait for the next iteration. Ray would end them after a second, and a new one takes
    # longer to start than the fits take.
    os.environ.setdefault("RAY_idle_worker_killing_time_threshold_ms", "300000")

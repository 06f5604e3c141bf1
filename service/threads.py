"""One thread for numerics: results must not depend on how a library splits its sums.

Parallelism comes from processes. The environment variables that say so are read when a library is loaded, which may
have been long before; so the libraries are told where the numbers are computed.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from t6gps.service import caller

with caller.untouched():  # its import sets a variable
    from threadpoolctl import threadpool_info, threadpool_limits


def limit() -> Callable[[], None]:
    """Let the libraries that are loaded compute with one thread from now on; the function that puts it back."""
    torch = sys.modules.get("torch")  # it keeps a number of its own, which threadpoolctl does not know
    threads_n = 1 if torch is None else torch.get_num_threads()
    limits = threadpool_limits(1)
    if torch is not None:
        torch.set_num_threads(1)

    def restore() -> None:
        limits.restore_original_limits()
        if torch is not None:
            torch.set_num_threads(threads_n)

    return restore


def blas() -> str:
    """The processor that NumPy's BLAS computes for, as it calls it. OPENBLAS_CORETYPE chooses, else the machine."""
    found = (library.get("architecture") for library in threadpool_info() if library["user_api"] == "blas")
    return next((name for name in found if name), "unknown")

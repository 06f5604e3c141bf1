"""T6-GPS from Python: train, evaluate, and ask runs. Each name stands on docs/python.md.

The import loads this file alone and changes nothing; a name loads what it needs when it is first used.
"""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from t6gps.service.api.policy import Policy
    from t6gps.service.api.run import Run, open_run, runs
    from t6gps.service.api.training import Progress, evaluate, train
    from t6gps.service.config import presets
    from t6gps.service.steering.status import Status
    from t6gps.service.stores.opening import open_store
    from t6gps.service.stores.store import Store
    from t6gps.service.training.evaluation import Evaluation
    from t6gps.storage.errors import ConfigError, QueryError, RunError, T6GpsError

    __version__: str
else:
    _MODULES = {
        "Policy": "t6gps.service.api.policy",
        "Run": "t6gps.service.api.run",
        "open_run": "t6gps.service.api.run",
        "runs": "t6gps.service.api.run",
        "Progress": "t6gps.service.api.training",
        "evaluate": "t6gps.service.api.training",
        "train": "t6gps.service.api.training",
        "presets": "t6gps.service.config",
        "Status": "t6gps.service.steering.status",
        "open_store": "t6gps.service.stores.opening",
        "Store": "t6gps.service.stores.store",
        "Evaluation": "t6gps.service.training.evaluation",
        "ConfigError": "t6gps.storage.errors",
        "QueryError": "t6gps.storage.errors",
        "RunError": "t6gps.storage.errors",
        "T6GpsError": "t6gps.storage.errors",
    }

    def __getattr__(name: str) -> object:
        import importlib

        if name == "__version__":
            from importlib import metadata

            value = metadata.version("t6gps")
        elif name in _MODULES:
            value = getattr(importlib.import_module(_MODULES[name]), name)
        else:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        globals()[name] = value
        return value

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


__all__ = [
    "ConfigError",
    "Evaluation",
    "Policy",
    "Progress",
    "QueryError",
    "Run",
    "RunError",
    "Status",
    "Store",
    "T6GpsError",
    "__version__",
    "evaluate",
    "open_run",
    "open_store",
    "presets",
    "runs",
    "train",
]

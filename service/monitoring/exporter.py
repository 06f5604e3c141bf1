"""The runs of a root as text for Prometheus: those at work first, then those that were at work last.

Beyond RUNS_MOST_N runs are counted and not looked into, so that a root may hold any number of them. What is damaged of
a run is left out and counted; everything else is told.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from importlib import metadata
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, InfoMetricFamily
from prometheus_client.metrics_core import Metric as Family
from prometheus_client.registry import Collector

from t6gps.service.monitoring import metrics, run_metrics
from t6gps.service.monitoring.metrics import METRICS, Kind, Metric
from t6gps.service.monitoring.run_metrics import Progress, Sample
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import T6GpsError

RUNS_MOST_N = 50
CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
FAMILIES = {Kind.GAUGE: GaugeMetricFamily, Kind.COUNTER: CounterMetricFamily}
Stamp = tuple[int, ...]


class _Found(NamedTuple):
    """A run, the process at work on it, and when one began with it last."""

    run: Run
    pid: int | None
    began: Stamp


class Exporter(Collector):
    """Tells how the runs of a root are, each time it is asked; one asks at a time.

    What has not changed is not read again: a table between two commits, and the lock of a run that nobody works on,
    which whoever takes it writes to.

    runs_most_n   runs that have metrics of their own
    """

    def __init__(self, root: Path, runs_most_n: int = RUNS_MOST_N) -> None:
        self._root, self._most_n, self._asked = root, runs_most_n, Lock()
        self._progress: dict[Run, tuple[Stamp, Progress]] = {}
        self._ended: dict[Run, Stamp] = {}
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(self)
        ProcessCollector(registry=self._registry)

    def text(self) -> bytes:
        """All metrics in Prometheus' text format, of CONTENT_TYPE."""
        with self._asked:
            return generate_latest(self._registry)

    def collect(self) -> Iterator[Family]:
        """The metrics; `prometheus_client` asks for them."""
        found, unreadable_n = self._found()
        runs_n = len(found) + unreadable_n
        shown = sorted(found, key=lambda each: (each.pid is not None, each.began), reverse=True)[: self._most_n]
        samples: dict[Run, list[Sample]] = {}
        for each in shown:
            samples[each.run], whole = self._samples(each)
            unreadable_n += not whole
        self._progress = {run: known for run, known in self._progress.items() if run in samples}
        disk = shutil.disk_usage(self._root) if self._root.is_dir() else None
        yield InfoMetricFamily("t6gps_build", "version of the server", value={"version": metadata.version("t6gps")})
        of_root = [
            Sample(metrics.RUNS, runs_n),
            Sample(metrics.RUNS_LEFT_OUT, len(found) - len(shown)),
            Sample(metrics.RUNS_UNREADABLE, unreadable_n),
        ]
        if disk is not None:
            of_root += [Sample(metrics.ROOT_SIZE, disk.total), Sample(metrics.ROOT_FREE, disk.free)]
        yield from _families(of_root, samples)

    def _found(self) -> tuple[list[_Found], int]:
        """The runs of the root, and how many there are of which nothing can be said."""
        found: list[_Found] = []
        runs, ended = catalog.list_runs(self._root), dict[Run, Stamp]()
        for run in runs:
            try:
                stamp = _stamp(run.path / ".lock")
                pid = None if self._ended.get(run) == stamp else catalog.process_of(run)
            except (T6GpsError, OSError):
                continue
            if pid is None:
                ended[run] = stamp
            found.append(_Found(run, pid, stamp))
        self._ended = ended
        return found, len(runs) - len(found)

    def _samples(self, found: _Found) -> tuple[list[Sample], bool]:
        """What can be said of a run, and whether that is everything."""
        samples: list[Sample] = []
        parts: tuple[Callable[[], Iterable[Sample]], ...] = (
            lambda: run_metrics.of_process(found.run, found.pid),
            lambda: run_metrics.of_folder(found.run, found.pid is not None),
            lambda: run_metrics.of_progress(self._known(found.run)),
        )
        whole = True
        for part in parts:
            try:
                samples += part()
            except (T6GpsError, OSError):  # it is counted; `t6gps runs` and `t6gps status` name the reason
                whole = False
        return samples, whole

    def _known(self, run: Run) -> Progress:
        """How far a run is; its tables are read when an iteration was committed since."""
        stamp = _stamp(run.tables / "episodes" / "_delta_log")  # of the table that is committed last
        known = self._progress.get(run)
        if known is None or known[0] != stamp:
            known = self._progress[run] = stamp, run_metrics.progress(run)
        return known[1]


def _stamp(path: Path) -> Stamp:
    """When a file or folder was changed last, and which it is; nothing where it is not there."""
    try:
        found = path.stat()
    except FileNotFoundError:
        return ()
    return found.st_mtime_ns, found.st_ino


def _families(of_root: Iterable[Sample], of_runs: Mapping[Run, Iterable[Sample]]) -> Iterator[Family]:
    """Samples by their metrics, in the order of METRICS."""
    rows: dict[Metric, list[tuple[list[str], float]]] = {metric: [] for metric in METRICS}
    for sample in of_root:
        rows[sample.metric].append(([], sample.value))
    for run, samples in of_runs.items():
        for sample in samples:
            labels = [run.name] + ([] if sample.label is None else [sample.label])
            rows[sample.metric].append((labels, sample.value))
    for metric, values in rows.items():
        family = FAMILIES[metric.kind](metric.name, metric.meaning, labels=metric.labels)
        for labels, value in values:
            family.add_metric(labels, float(value))
        yield family

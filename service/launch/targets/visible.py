"""What launchers share whose root this machine sees too: a job's log is a file, and its run is at hand."""

from __future__ import annotations

import logging
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from t6gps.service.launch.fetch import FolderSource, Source
from t6gps.service.launch.folder import Planned
from t6gps.service.launch.job import ENDED, Job, JobState
from t6gps.service.launch.targets import errand
from t6gps.service.steering import requests
from t6gps.service.steering.status import Status
from t6gps.service.training import publishing
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

TICK_S = 0.2
_log = logging.getLogger(__name__)


class VisibleLauncher(ABC):
    """A `Launcher` whose jobs write into a root that this machine sees."""

    @abstractmethod
    def check(self, planned: Sequence[Planned]) -> None: ...

    @abstractmethod
    def render(self, planned: Sequence[Planned]) -> str: ...

    @abstractmethod
    def submit(self, planned: Sequence[Planned]) -> list[str]: ...

    @abstractmethod
    def state(self, job: Job) -> tuple[JobState, str]: ...

    @abstractmethod
    def stop(self, job: Job) -> None: ...

    @abstractmethod
    def cancel(self, job: Job) -> None: ...

    def logs(self, job: Job, follow: bool) -> Iterator[str]:
        path = job.folder.log
        while follow and not path.exists() and self.state(job)[0] not in ENDED:
            time.sleep(TICK_S)
        try:
            with path.open(encoding="utf-8", errors="replace") as file:
                while True:
                    ended = not follow or self.state(job)[0] in ENDED
                    while text := file.read(1 << 16):
                        yield text
                    if ended:  # asked before the last reading
                        return
                    time.sleep(TICK_S)
        except FileNotFoundError:
            raise RunError(f"job {job.name} has no log {path} yet; see t6gps jobs") from None

    def status(self, job: Job) -> Status | None:
        return errand.status(job.root, job.run)

    def scale(self, job: Job, workers: int, deadline_s: float) -> Status:
        return requests.scale(_run(job), workers, deadline_s)

    def source(self, job: Job) -> AbstractContextManager[Source]:
        return nullcontext(FolderSource(_run(job)))


def check_publishing(planned: Sequence[Planned]) -> None:
    """See that jobs whose environment is that of this process can publish their runs. Errors as `check_all`."""
    root = publishing.target(planned[0].publish)
    if root is not None:
        publishing.check_all([Run(job.folder.root / job.folder.run) for job in planned], root, _log.warning)


def _run(job: Job) -> Run:
    return catalog.open_run(Path(job.root), job.run)

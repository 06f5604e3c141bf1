"""The port `Launcher`: what is asked of a target, the same for all kinds; and which kind has which leaf."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import Protocol

from t6gps.service.launch.fetch import Source
from t6gps.service.launch.folder import Planned
from t6gps.service.launch.job import Job, JobState
from t6gps.service.steering.status import Status


class Launcher(Protocol):
    """A target on which jobs run. Every method raises RunError where the target cannot be used or reached."""

    def check(self, planned: Sequence[Planned]) -> None:
        """ConfigError, RunError or StoreError for runs that this target cannot take, or publish; nothing is changed.

        They have one configuration, but for the seed.
        """
        ...

    def render(self, planned: Sequence[Planned]) -> str:
        """What `submit` would do, as commands and files to read."""
        ...

    def submit(self, planned: Sequence[Planned]) -> list[str]:
        """Start a job for each of these, whose folders are prepared; their numbers on the target."""
        ...

    def state(self, job: Job) -> tuple[JobState, str]:
        """How a job is, and where or why in words."""
        ...

    def logs(self, job: Job, follow: bool) -> Iterator[str]:
        """What a job has written so far; with `follow` also what it goes on to write, until it ends."""
        ...

    def stop(self, job: Job) -> None:
        """Ask a job to stop cleanly; does not wait."""
        ...

    def cancel(self, job: Job) -> None:
        """End a job and its processes at once; does not wait."""
        ...

    def status(self, job: Job) -> Status | None:
        """How the run of a job is, None where it has no workers yet."""
        ...

    def scale(self, job: Job, workers: int, deadline_s: float) -> Status:
        """Give the run of a job `workers` workers, and wait for them; its status then. Errors as `requests.scale`."""
        ...

    def source(self, job: Job) -> AbstractContextManager[Source]:
        """Where the files of the run of a job come from, for the time of the context."""
        ...

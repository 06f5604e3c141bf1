"""Jobs on a cluster of Ray that is up, by its Jobs API. A job's number is Ray's submission id.

The root is a folder that this machine and the cluster's head both see; or, with ray.root, one that only the cluster
sees. Then the job's folder is brought there, and errands on the head look at the run.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from functools import cached_property
from pathlib import Path
from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

from t6gps.service import config as configuration
from t6gps.service import provenance
from t6gps.service.config import Config
from t6gps.service.launch import folder as folders
from t6gps.service.launch import job as records
from t6gps.service.launch.fetch import Source
from t6gps.service.launch.folder import Folder, Planned
from t6gps.service.launch.job import OUTCOMES, Job, JobState
from t6gps.service.launch.target import Ray
from t6gps.service.launch.targets.visible import VisibleLauncher
from t6gps.service.ray_backend import jobs_api
from t6gps.service.ray_backend.errands import Node, Survey
from t6gps.service.ray_backend.jobs_api import JobsApi
from t6gps.service.steering.status import Status
from t6gps.service.training import publishing
from t6gps.storage.errors import ConfigError, RunError

SAME = ("t6gps", "schema")
"""What this machine and the cluster must have alike: it writes the configuration, and reads the tables."""
Result = TypeVar("Result")
SURVEY, REACHED = TypeAdapter(Survey), TypeAdapter(Status)
STATUS: TypeAdapter[Status | None] = TypeAdapter(Status | None)
PLACED, NOTHING = TypeAdapter(list[str]), TypeAdapter(None)
"""What errands bring."""
STATES = {
    "PENDING": JobState.PENDING,
    "RUNNING": JobState.RUNNING,
    "SUCCEEDED": JobState.DONE,
    "STOPPED": JobState.STOPPED,
}
"""Ray's words; how a job FAILED, its exit code says."""


class RayLauncher(VisibleLauncher):
    """The launcher of a cluster of Ray."""

    def __init__(self, target: Ray) -> None:
        self.target = target

    @cached_property
    def api(self) -> JobsApi:
        """The connection, made when it is needed first."""
        return JobsApi(self.target.address)

    def check(self, planned: Sequence[Planned]) -> None:
        publishing.address(planned[0].publish)  # the keys are those of the cluster
        self.api  # noqa: B018  connects

    def render(self, planned: Sequence[Planned]) -> str:
        first = [] if self.target.root is None else [f"# the jobs' folders are brought to {self.target.root} first"]
        options = f"--address {self.target.address} --no-wait --runtime-env-json '{json.dumps(jobs_api.ENVIRONMENT)}'"
        folders = [job.folder for job in planned]
        calls = [jobs_api.entrypoint(self._command(folder), self.target.bin) for folder in folders]
        return "\n".join([*first, *(f"ray job submit {options} -- {call}" for call in calls)])

    def submit(self, planned: Sequence[Planned]) -> list[str]:
        folders = [job.folder for job in planned]
        config = configuration.load(str(folders[0].config))
        root, script = (str(path) for path in (self._there(folders[0]).root, folders[0].script))
        survey = self._errand(SURVEY, "look", root, script)
        if self.target.root is None and not survey.sees_file:
            raise RunError(
                f"{root} is not the same folder on the cluster {self.target.address}; give a --root that both see, or "
                "name the cluster's own by ray.root in the file of targets"
            )
        judge(survey, config, root)
        if planned[0].publish is not None:
            self._errand(NOTHING, "publish", root, planned[0].publish, *(folder.run for folder in folders))
        if self.target.root is not None:
            self._place(config, folders)
        return self._started(folders)

    def state(self, job: Job) -> tuple[JobState, str]:
        known = self.api.details(job.native_id)
        if known is None:
            code = job.folder.exit_code if self.target.root is None else None
            forgotten = f"{self.target.address} knows it no longer, restarted perhaps; resume with --resume"
            return (OUTCOMES[code], "") if code in OUTCOMES else (JobState.FAILED, forgotten)
        if known.status in STATES:
            return STATES[known.status], known.message or "" if known.status == "PENDING" else ""
        code = known.driver_exit_code
        if code in OUTCOMES:
            return OUTCOMES[code], ""
        words = "" if code is None else jobs_api.last_words(self.api.log(job.native_id).splitlines())
        return JobState.FAILED, words or known.message or "ended without a word; resume with --resume"

    def logs(self, job: Job, follow: bool) -> Iterator[str]:
        if self.api.details(job.native_id) is None:
            raise RunError(f"{self.target.address} knows job {job.name} no longer, nor its log; see t6gps jobs")
        return self.api.follow(job.native_id) if follow else iter([self.api.log(job.native_id)])

    def stop(self, job: Job) -> None:
        self.api.stop(job.native_id)

    def cancel(self, job: Job) -> None:
        """As `stop`: Ray kills a job that does not heed it for long."""
        self.api.stop(job.native_id)

    def status(self, job: Job) -> Status | None:
        if self.target.root is None:
            return super().status(job)
        return self._errand(STATUS, "status", self.target.root, job.run)

    def scale(self, job: Job, workers: int, deadline_s: float) -> Status:
        if self.target.root is None:
            return super().scale(job, workers, deadline_s)
        return self._errand(REACHED, "scale", self.target.root, job.run, str(workers), str(deadline_s))

    def source(self, job: Job) -> AbstractContextManager[Source]:
        if self.target.root is None:
            return super().source(job)
        raise RunError(
            f"run {job.run} lies in {self.target.root} on the cluster, which this machine does not see; run there "
            f"t6gps serve --root {self.target.root}, and here t6gps fetch {job.run} --server URL"
        )

    def _there(self, folder: Folder) -> Folder:
        """A job's folder as the cluster has it."""
        return folder if self.target.root is None else Folder(Path(self.target.root) / folders.FOLDERS / folder.run)

    def _command(self, folder: Folder) -> list[str]:
        there = self._there(folder)
        return ["bash", str(there.script), str(there.path)]

    def _errand(self, result: TypeAdapter[Result], name: str, *arguments: str, folder: Path | None = None) -> Result:
        said = self.api.errand(self.target.bin, name, *arguments, folder=folder)
        try:
            return result.validate_json(said)
        except ValidationError:
            raise RunError(f"{self.target.address} has another version of t6gps; {jobs_api.INSTALL}") from None

    def _place(self, config: Config, here: Sequence[Folder]) -> None:
        """Bring the jobs' folders into the cluster's root. RunError where that has a run of such a name."""
        again = all(records.find(folder.root, folder.run) is not None for folder in here)
        with tempfile.TemporaryDirectory() as draft:
            for folder in here:
                (Path(draft) / folder.run).mkdir()
                there = Planned(configuration.load(str(folder.config)), self._there(folder), folder.publish)
                folders.write(there, Path(draft) / folder.run)
            runs = [folder.run for folder in here]
            self._errand(PLACED, "place", str(self.target.root), "again" if again else "", *runs, folder=Path(draft))

    def _started(self, here: Sequence[Folder]) -> list[str]:
        """Start the jobs; where one cannot be, the others are stopped."""
        numbers: list[str] = []
        try:
            for folder in here:
                numbers.append(self.api.submit(self._command(folder), self.target.bin))
        except BaseException:
            for number in numbers:
                with suppress(RunError):  # the first error says what is wrong
                    self.api.stop(number)
            if self.target.root is not None:
                with suppress(RunError):
                    self._errand(NOTHING, "remove", self.target.root, *(folder.run for folder in here))
            raise
        return numbers


def judge(survey: Survey, config: Config, root: str) -> None:
    """RunError or ConfigError for a cluster on which the run would not start, or not wholly."""
    head, nodes = survey.head, (survey.head, *survey.others)
    for node in nodes:
        if node.fault:
            remedy = (
                jobs_api.INSTALL if "No module named" in node.fault else "see ray status, and mend or remove the node"
            )
            raise RunError(f"node {node.address}: {node.fault}; {remedy}")
    here = provenance.build()
    _same(head, {name: here[name] for name in SAME}, "this machine")
    for node in survey.others:
        _same(node, head.build, f"the head {head.address}")
        if config.terrain.file is not None and not node.sees_root:
            raise RunError(
                f"node {node.address} does not see {root}, from which workers read the ground {config.terrain.file}; "
                "use a root that all nodes share"
            )
    _fits(nodes, config)


def _same(node: Node, wanted: dict[str, str], whose: str) -> None:
    """RunError where a node has another installation."""
    found = {name: node.build[name] for name in wanted if name in node.build}
    if others := provenance.differences(found, wanted, whose):
        raise RunError(f"node {node.address} has another installation: {others}; install the same on both")


def _fits(nodes: Sequence[Node], config: Config) -> None:
    """ConfigError for more workers than there are CPUs, where the run does not ask for nodes."""
    size = config.run
    room = sum(int(node.cpus / size.cpus_per_worker + 1e-6) for node in nodes)
    if size.autoscale is None and size.workers > room:
        raise ConfigError(
            f"{size.workers} workers of run.cpus_per_worker = {size.cpus_per_worker:g} do not fit on the "
            f"{len(nodes)} nodes of the cluster; allowed: {room}; lower --workers, or let an autoscaler bring nodes "
            f"with --autoscale 1:{size.workers}"
        )

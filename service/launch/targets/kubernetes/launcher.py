"""Jobs on a Kubernetes cluster with KubeRay: each is a RayJob, and its run lies on a claim."""

from __future__ import annotations

import codecs
import json
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext

from pydantic import JsonValue, TypeAdapter

from t6gps.service.launch import job as records
from t6gps.service.launch.fetch import Source
from t6gps.service.launch.folder import Planned
from t6gps.service.launch.job import ENDED, OUTCOMES, Job, JobState
from t6gps.service.launch.target import K8s
from t6gps.service.launch.targets.kubernetes import claim, manifests, pods
from t6gps.service.launch.targets.kubernetes.claim import ClaimSource, Place
from t6gps.service.launch.targets.kubernetes.kubectl import Kubectl, at
from t6gps.service.launch.targets.kubernetes.pods import Manifest
from t6gps.service.steering.status import Status
from t6gps.service.training import publishing
from t6gps.storage.errors import ConfigError, RunError

TICK_S, PATIENCE_S, GONE_S = 1.0, 120.0, 120.0
"""How often the cluster is looked at, how long a head may be gone that is said to run, and how long removing takes."""
ALIVE, FAILED = ("Running", "Suspending"), ("Failed", "ValidationFailed")
"""KubeRay's words for jobs that have pods, and for those that it has given up."""
PID = "/tmp/t6gps.pid"
NOBODY = "-"
"""A name that no run can have."""
STATUS = TypeAdapter(Status | None)


class KubernetesLauncher:
    """The launcher of a Kubernetes cluster. A job's number is the name of its RayJob."""

    def __init__(self, target: K8s) -> None:
        self.target = target
        self.kubectl = Kubectl(target.context, target.namespace)

    def check(self, planned: Sequence[Planned]) -> None:
        publishing.address(planned[0].publish)  # the keys are in the cluster
        objects = manifests.job(planned[0].config, NOBODY, self.target, planned[0].publish)
        self._check_claim()
        for manifest in objects:
            self.kubectl.create(manifest, dry_run=True)

    def render(self, planned: Sequence[Planned]) -> str:
        return manifests.to_yaml([manifest for job in planned for manifest in self._objects(job)])

    def submit(self, planned: Sequence[Planned]) -> list[str]:
        made: list[Manifest] = []
        try:
            for job in planned:
                self._make_way(job)
                for manifest in self._objects(job):
                    self.kubectl.create(manifest)
                    made.append(manifest)
        except BaseException:
            _remove(self.kubectl, made)
            raise
        return [manifests.name(job.folder.run, self.target) for job in planned]

    def state(self, job: Job) -> tuple[JobState, str]:
        ray_job = self.kubectl.get("rayjob", job.native_id)
        if ray_job is None:
            return self._outcome(job)
        status = at(ray_job, "status")
        word = at(status, "jobDeploymentStatus")
        if word == "Complete":
            return (JobState.STOPPED if at(status, "jobStatus") == "STOPPED" else JobState.DONE), ""
        if word == "Suspended":
            return JobState.STOPPED, "its RayJob is suspended"
        if word in FAILED:
            return JobState.FAILED, _last_line(at(status, "message")) or str(at(status, "reason"))
        if word in ALIVE:
            failed = at(status, "failed")
            return JobState.RUNNING, f"on {at(status, 'rayClusterName')}" + (f", retry {failed}" if failed else "")
        return JobState.PENDING, _wait(self.kubectl, job)

    def logs(self, job: Job, follow: bool) -> Iterator[str]:
        path, offset, heard_s = f"{pods.ROOT}/.jobs/{job.run}/log", 0, time.monotonic()
        decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
        while True:
            state = self.state(job)[0]
            ended = not follow or state in ENDED  # asked before the last reading
            if ended and state is JobState.PENDING:
                raise RunError(f"job {job.name} has no log yet; see t6gps jobs")
            try:
                for piece in self._rest(job, state, path, offset):
                    offset += len(piece)
                    yield decoder.decode(piece)
                heard_s = time.monotonic()
            except RunError:  # a head that is lost takes KubeRay a while to miss
                if ended or time.monotonic() > heard_s + PATIENCE_S:
                    raise
            if ended:
                return
            time.sleep(TICK_S)

    def stop(self, job: Job) -> None:
        head = claim.head(self.kubectl, job.native_id)
        if head is None or head.execute("sh", "-c", f'kill -TERM "$(cat {PID})" 2>&1 || echo none').strip():
            self.cancel(job)  # nothing runs that could stop, or say so

    def cancel(self, job: Job) -> None:
        self.kubectl.patch("rayjob", job.native_id, [{"op": "add", "path": "/spec/suspend", "value": True}])

    def status(self, job: Job) -> Status | None:
        state = self.state(job)[0]
        if state is JobState.PENDING:
            return None
        with self._place(job, state) as place:
            return STATUS.validate_python(place.errand("status", job.run))

    def scale(self, job: Job, workers: int, deadline_s: float) -> Status:
        head = self._head(job)
        ray_cluster, running_n = _group(self.kubectl, job)
        config = json.loads(head.execute("cat", f"{pods.ROOT}/{job.run}/config.json"))
        pods_n = max(1, manifests.pods_for(workers, config["run"]["cpus_per_worker"], self.target))  # fits need CPUs
        if pods_n > running_n:
            _resize(self.kubectl, ray_cluster, pods_n)
        reached = STATUS.validate_python(head.errand("scale", job.run, str(workers), str(deadline_s)))
        if pods_n < running_n:  # workers of a pod that goes move to those that stay
            _resize(self.kubectl, ray_cluster, pods_n)
        assert reached is not None, "it was scaled"
        return reached

    @contextmanager
    def source(self, job: Job) -> Iterator[Source]:
        if self.state(job)[0] not in ENDED:
            raise RunError(f"job {job.name} trains run {job.run}; stop it, or wait for it to end")
        with claim.reader(self.kubectl, self.target) as place:
            yield ClaimSource(place, job.run)

    def _objects(self, job: Planned) -> list[Manifest]:
        return manifests.job(job.config, job.folder.run, self.target, job.publish)

    def _make_way(self, job: Planned) -> None:
        """Remove the objects of this desk's earlier job of that run. RunError where that has not ended."""
        before = next((known for known in records.jobs() if known.folder == job.folder), None)
        if before is None or before.native_id != manifests.name(job.folder.run, self.target):
            return
        if (state := self.state(before)[0]) not in ENDED:
            raise RunError(f"job {before.name} is {state}; end it with t6gps stop {before.name}")
        _remove(self.kubectl, self._objects(job))

    def _check_claim(self) -> None:
        """RunError where the claim is not there, or not for several nodes."""
        found = self.kubectl.get("persistentvolumeclaim", self.target.claim)
        where = f"k8s.claim = {self.target.claim} in namespace {self.target.namespace}"
        if found is None:
            raise RunError(f"{where} is not there; make that PersistentVolumeClaim, or correct the file of targets")
        modes = at(found, "spec", "accessModes")
        if not isinstance(modes, list) or "ReadWriteMany" not in modes:
            raise ConfigError(f"{where} is not shared: it has {modes}; allowed: ReadWriteMany; make another claim")

    def _outcome(self, job: Job) -> tuple[JobState, str]:
        """How a job ended whose RayJob somebody has removed: what its script wrote on the claim."""
        path, gone = f"{pods.ROOT}/.jobs/{job.run}/exit_code", f"its RayJob {job.native_id} was removed"
        with claim.reader(self.kubectl, self.target) as place:
            code = place.execute("sh", "-c", f"[ ! -e {path} ] || cat {path}").strip()
        return (
            (OUTCOMES.get(int(code), JobState.FAILED), gone) if code else (JobState.FAILED, f"{gone} before it ended")
        )

    def _rest(self, job: Job, state: JobState, path: str, offset: int) -> Iterator[bytes]:
        """What a job's log has from a byte on."""
        if state is not JobState.PENDING:
            with self._place(job, state) as place:
                yield from place.stream("sh", "-c", f"[ ! -e {path} ] || exec tail --bytes=+{offset + 1} {path}")

    def _place(self, job: Job, state: JobState) -> AbstractContextManager[Place]:
        """Where the claim is seen: on the head of a job that runs, else in a pod made for it."""
        return nullcontext(self._head(job)) if state is JobState.RUNNING else claim.reader(self.kubectl, self.target)

    def _head(self, job: Job) -> Place:
        """The head of a job. RunError where none runs."""
        head = claim.head(self.kubectl, job.native_id)
        if head is None:
            raise RunError(f"job {job.name} has no head that runs just now; see t6gps jobs, and ask again")
        return head


def _group(kubectl: Kubectl, job: Job) -> tuple[str, int]:
    """The RayCluster of a job, and how many pods with workers it shall have."""
    name = str(at(kubectl.get("rayjob", job.native_id), "status", "rayClusterName"))
    replicas = at(kubectl.get("raycluster", name), "spec", "workerGroupSpecs", 0, "replicas")
    if not isinstance(replicas, int):
        raise RunError(f"job {job.name} has no RayCluster; see t6gps status {job.name}")
    return name, replicas


def _resize(kubectl: Kubectl, ray_cluster: str, pods_n: int) -> None:
    path = "/spec/workerGroupSpecs/0/replicas"
    kubectl.patch("raycluster", ray_cluster, [{"op": "replace", "path": path, "value": pods_n}])


def _remove(kubectl: Kubectl, objects: Sequence[Manifest]) -> None:
    """Remove objects, the last first, and see them gone: an object of that name may follow."""
    deadline = time.monotonic() + GONE_S
    for manifest in reversed(objects):
        kind, metadata = str(manifest["kind"]), manifest["metadata"]
        assert isinstance(metadata, dict)
        kubectl.delete(kind, metadata["name"])
        while kubectl.get(kind, metadata["name"]) is not None:
            if time.monotonic() > deadline:
                raise RunError(f"{kind} {metadata['name']} is still there after {GONE_S:.0f} s; see what holds it")
            time.sleep(TICK_S)


def _wait(kubectl: Kubectl, job: Job) -> str:
    """What a job waits for: the first of its pods that says why it does not run."""
    reasons = map(claim.reason, kubectl.pods(f"{manifests.LABEL}={job.native_id}"))
    return next(filter(None, reasons), "")


def _last_line(message: JsonValue) -> str:
    lines = [line.strip() for line in str(message or "").splitlines()]
    return next((line for line in reversed(lines) if line), "")

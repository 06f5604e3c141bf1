"""Looking into the root of runs on a claim, which only pods see: in the head of a job, or in a pod made for it."""

from __future__ import annotations

import io
import itertools
import json
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

from pydantic import JsonValue, TypeAdapter

from t6gps.service.launch.fetch import File
from t6gps.service.launch.target import K8s
from t6gps.service.launch.targets.kubernetes import manifests, pods
from t6gps.service.launch.targets.kubernetes.kubectl import Kubectl, at
from t6gps.storage.errors import RunError

STARTED_S, TICK_S = 300.0, 0.5
"""How long a pod may take to start, image included, and how often it is looked at."""
STUCK = ("ErrImagePull", "ImagePullBackOff", "InvalidImageName", "CreateContainerConfigError", "CreateContainerError")
SMALL_BYTES, TOGETHER_N = 1 << 18, 64
"""What counts as a small file, and how many of them come at once."""
LISTING = TypeAdapter(dict[str, tuple[int, str]])


@dataclass(frozen=True)
class Place:
    """A container that sees the claim."""

    kubectl: Kubectl
    pod: str
    container: str

    def execute(self, *command: str) -> str:
        """What a command prints there. RunError in its own words where it fails."""
        return self.kubectl.execute(self.pod, self.container, *command)

    def errand(self, name: str, *arguments: str) -> JsonValue:
        """The answer to an errand there (`launch.errand`)."""
        return json.loads(
            self.execute("python3", "-m", "t6gps.service.launch.targets.errand", name, pods.ROOT, *arguments)
        )

    def stream(self, *command: str) -> Iterator[bytes]:
        return self.kubectl.stream(self.pod, self.container, *command)


@dataclass
class ClaimSource:
    """A run on a claim, as `fetch` asks for it. Small files come many at once: each call of kubectl takes a while."""

    place: Place
    run: str
    listed: dict[str, File] = field(default_factory=dict)
    waiting: dict[str, bytes] = field(default_factory=dict)

    def files(self) -> dict[str, File]:
        listing = LISTING.validate_python(self.place.errand("files", self.run))
        self.listed = {path: File(size, sha256) for path, (size, sha256) in listing.items()}
        return self.listed

    def pieces(self, path: str, offset: int) -> Iterator[bytes]:
        try:
            if self.listed[path].size <= SMALL_BYTES:
                if path not in self.waiting:
                    self.waiting = self._together(path)
                yield self.waiting.pop(path)[offset:]
                return
            yield from self.place.stream("tail", f"--bytes=+{offset + 1}", f"{pods.ROOT}/{self.run}/{path}")
        except RunError as error:
            raise ConnectionError(str(error)) from error

    def _together(self, first: str) -> dict[str, bytes]:
        """A small file and those that follow it in the listing."""
        following = itertools.dropwhile(lambda path: path != first, self.listed)
        paths = [path for path in following if self.listed[path].size <= SMALL_BYTES][:TOGETHER_N]
        content = io.BytesIO(b"".join(self.place.stream("cat", *(f"{pods.ROOT}/{self.run}/{path}" for path in paths))))
        return {path: content.read(self.listed[path].size) for path in paths}


def head(kubectl: Kubectl, instance: str) -> Place | None:
    """The head of a job's Ray cluster, None where none is running."""
    for pod in kubectl.pods(f"{manifests.LABEL}={instance}", "ray.io/node-type=head"):
        if at(pod, "status", "phase") == "Running" and not at(pod, "metadata", "deletionTimestamp"):
            return Place(kubectl, str(at(pod, "metadata", "name")), pods.RAY_CONTAINER)
    return None


@contextmanager
def reader(kubectl: Kubectl, target: K8s) -> Iterator[Place]:
    """A pod of its own that sees the claim, for the time of the context."""
    name = f"t6gps-reader-{secrets.token_hex(4)}"
    try:
        kubectl.create(manifests.reader(name, target))
        deadline = time.monotonic() + STARTED_S
        while (pod := kubectl.get("pod", name)) is None or at(pod, "status", "phase") != "Running":
            why = "" if pod is None else reason(pod)
            if time.monotonic() > deadline or why.startswith(STUCK):
                raise RunError(f"pod {name}, which would read the claim {target.claim}, does not start: {why}")
            time.sleep(TICK_S)
        yield Place(kubectl, name, "reader")
    finally:
        kubectl.delete("pod", name)


def reason(pod: JsonValue) -> str:
    """Why a pod does not run, in its own words; empty where it says nothing."""
    for status in _items(at(pod, "status", "containerStatuses")):
        if at(status, "state", "waiting"):
            return _words(at(status, "state", "waiting"))
    for condition in _items(at(pod, "status", "conditions")):
        if at(condition, "type") == "PodScheduled" and at(condition, "status") == "False":
            return _words(condition)
    return ""


def _items(value: JsonValue) -> list[JsonValue]:
    return value if isinstance(value, list) else []


def _words(value: JsonValue) -> str:
    return f"{at(value, 'reason')} {at(value, 'message') or ''}".strip()

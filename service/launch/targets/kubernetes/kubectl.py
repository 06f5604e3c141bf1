"""The cluster, by its own program kubectl: the only place that calls it."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass

import yaml
from pydantic import JsonValue

from t6gps.service.launch.targets.kubernetes.pods import Manifest
from t6gps.storage.errors import RunError

ANSWER_S, REQUEST_S = 120.0, 20
"""How long kubectl may take, and how long it waits for the cluster to answer once."""
PIECE_BYTES = 1 << 20
UNREACHED = "see that the cluster is up and reached from here, and that k8s.context is the one you mean"
TOO_OLD = "let KubeRay 1.6 or later be installed in the cluster, with its own resource definitions"
REMEDIES = {
    '" does not exist': "correct k8s.context in the file of targets",
    "was refused": UNREACHED,
    "connection refused": UNREACHED,
    "no such host": UNREACHED,
    "i/o timeout": UNREACHED,
    "handshake timeout": UNREACHED,
    "deadline exceeded": UNREACHED,
    "Client.Timeout exceeded": UNREACHED,
    "be logged in": "log in to the cluster, as its administrator says",
    "exceeded quota": "lower what the file of targets asks for, or ask for a larger quota",
    "is forbidden": "ask the cluster's administrator for that permission, or choose another k8s.namespace",
    "no matches for kind": TOO_OLD,
    "have a resource type": TOO_OLD,
    "unknown field": TOO_OLD,
    "already exists": "a job of this run and claim is there already; choose another name with --run",
    'namespaces "': "correct k8s.namespace in the file of targets",
}
"""By words of kubectl, of which the first that it says counts: it has no numbers for them."""
NOT_SAID = re.compile(r"command terminated with exit code|[EWI]\d{4} \d\d:")
"""Lines that repeat what others say better: of a command inside a pod, and of kubectl's own log."""


def at(value: JsonValue, *keys: str | int) -> JsonValue:
    """What lies under these keys of an object, None where there is nothing."""
    for key in keys:
        if isinstance(value, dict) and isinstance(key, str):
            value = value.get(key)
        elif isinstance(value, list) and isinstance(key, int) and key < len(value):
            value = value[key]
        else:
            return None
    return value


@dataclass(frozen=True)
class Kubectl:
    """kubectl for a namespace of a cluster. Methods raise RunError where it is missing, refuses, or gets no answer."""

    context: str | None
    namespace: str

    def create(self, manifest: Manifest, dry_run: bool = False) -> None:
        """Make an object; with `dry_run` only let the cluster judge it. Fields that it does not know are refused."""
        options = ["--dry-run=server"] if dry_run else []
        self._asked("create", "--validate=strict", *options, "--filename=-", text=yaml.safe_dump(manifest))

    def get(self, kind: str, name: str) -> JsonValue:
        """An object as it is now, None where there is none."""
        text = self._asked("get", kind, name, "--output=json", "--ignore-not-found")
        return json.loads(text) if text.strip() else None

    def pods(self, *labels: str) -> list[JsonValue]:
        """The pods that have these labels."""
        return json.loads(self._asked("get", "pods", f"--selector={','.join(labels)}", "--output=json"))["items"]

    def patch(self, kind: str, name: str, change: JsonValue) -> None:
        """Change an object by a JSON patch."""
        self._asked("patch", kind, name, "--type=json", f"--patch={json.dumps(change)}")

    def delete(self, kind: str, name: str) -> None:
        """Let an object go that may be gone already; does not wait."""
        self._asked("delete", kind, name, "--ignore-not-found", "--wait=false")

    def execute(self, pod: str, container: str, *command: str) -> str:
        """What a command inside a container prints."""
        return b"".join(self.stream(pod, container, *command)).decode()

    def stream(self, pod: str, container: str, *command: str) -> Iterator[bytes]:
        """What a command inside a container prints, while it prints it."""
        call = [*self._begin(), "exec", pod, f"--container={container}", "--", *command]
        with _started(call) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            try:
                while piece := process.stdout.read(PIECE_BYTES):
                    yield piece
                said = process.stderr.read().decode(errors="replace")
            except BaseException:
                process.kill()
                raise
        if process.returncode != 0:
            raise _refusal(said)

    def _asked(self, *arguments: str, text: str = "") -> str:
        call = [*self._begin(), f"--request-timeout={REQUEST_S}s", *arguments]
        with _started(call) as process:
            try:
                out, said = process.communicate(text.encode(), timeout=ANSWER_S)
            except subprocess.TimeoutExpired:
                process.kill()
                raise RunError(f"kubectl {arguments[0]} has not ended within {ANSWER_S:.0f} s; {UNREACHED}") from None
            except BaseException:
                process.kill()
                raise
        if process.returncode != 0:
            raise _refusal(said.decode(errors="replace"))
        return out.decode()

    def _begin(self) -> list[str]:
        context = [] if self.context is None else [f"--context={self.context}"]
        return ["kubectl", *context, f"--namespace={self.namespace}"]


def _started(call: list[str]) -> subprocess.Popen[bytes]:
    pipe = subprocess.PIPE
    try:
        return subprocess.Popen(call, stdin=pipe, stdout=pipe, stderr=pipe)
    except FileNotFoundError:
        raise RunError(
            "there is no program kubectl on this machine; install it (kubernetes-client in Debian), or add it to PATH"
        ) from None


def _refusal(said: str) -> RunError:
    """The error that kubectl's words make, those of a command inside a pod as it said them."""
    lines = [line.removeprefix("error: ").strip() for line in said.splitlines()]
    words = " ".join(line for line in lines if line and not NOT_SAID.match(line))
    remedy = next((remedy for known, remedy in REMEDIES.items() if known in words), None)
    return RunError(f"the cluster said: {words or 'nothing'}" + (f"; {remedy}" if remedy else ""))

"""Pods as processes of this machine: `with network(folder) as net: pod = net.pod(...)`.

A pod has an address of its own in a network of its own. Each container has processes, mounts and a root file system of
its own, read-only but for its volumes. Claims are folders. Not as in a pod: the image is this machine and its Python,
and the user is the one of the tests. Needs root, iproute2 and util-linux.
"""

from __future__ import annotations

import base64
import itertools
import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PROGRAMS = ("ip", "nsenter", "unshare", "chroot", "kubectl")
REPOSITORY = Path(__file__).parents[2]
ENVIRONMENT = {
    "PATH": f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin:/usr/sbin:/sbin",
    "LANG": "C.UTF-8",
    "OMP_NUM_THREADS": "1",
}
SPECIAL = ("proc", "dev", "sys")


@dataclass
class Container:
    """A container that was started: its processes end with the first of them."""

    process: subprocess.Popen[bytes]
    environment: dict[str, str]

    @property
    def pid(self) -> int | None:
        """Its first process as this machine numbers it, None before it has its root."""
        unshare = self.process.pid
        try:
            child = int(Path(f"/proc/{unshare}/task/{unshare}/children").read_text().split()[0])
            return child if Path(f"/proc/{child}/root").readlink() != Path("/") else None
        except (FileNotFoundError, ProcessLookupError, IndexError):
            return None

    def call(self, command: list[str]) -> subprocess.Popen[bytes]:
        """Start a command inside."""
        inside = ["nsenter", f"--target={self.pid}", "--mount", "--pid", "--net", "--root"]
        pipe = subprocess.PIPE
        return subprocess.Popen([*inside, *_with(self.environment), *command], stdout=pipe, stderr=pipe)

    def kill(self) -> None:
        self.process.kill()  # the kernel ends all the others with it
        self.process.wait()


@dataclass
class Pod:
    """A pod: its manifest, its address, and the containers that were started."""

    manifest: dict[str, Any]
    address: str
    folder: Path
    namespace: str
    containers: dict[str, Container] = field(default_factory=dict)

    def start(self, container: dict[str, Any], command: list[str], mounts: dict[str, Path]) -> None:
        """Start a container of the pod. `mounts` says where each of the pod's volumes lies."""
        environment = ENVIRONMENT | {entry["name"]: entry["value"] for entry in container.get("env", [])}
        root = self.folder / f"root-{container['name']}"
        root.mkdir()
        setup = _setup(root, container, mounts)
        script = "\n".join(["set -e", *setup, shlex.join(["exec", "chroot", str(root), *_with(environment), *command])])
        unshare = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "bash", "-c", script]
        with (self.folder / f"{container['name']}.log").open("wb") as log:
            process = subprocess.Popen(
                ["nsenter", f"--net=/run/netns/{self.namespace}", *unshare],
                stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip
        self.containers[container["name"]] = Container(process, environment)

    @property
    def phase(self) -> str:
        main = next(iter(self.containers.values()), None)
        if main is None:
            return "Pending"
        if main.process.poll() is not None:
            return "Failed" if main.process.returncode else "Succeeded"
        return "Pending" if main.pid is None else "Running"

    def kill(self) -> None:
        for container in self.containers.values():
            container.kill()


@dataclass
class Network:
    """Where pods reach each other; all of them end with it."""

    name: str
    folder: Path
    numbers: Iterator[int] = field(default_factory=lambda: itertools.count(1))
    pods: list[Pod] = field(default_factory=list)

    def pod(self, manifest: dict[str, Any]) -> Pod:
        """A pod without containers yet."""
        number = next(self.numbers)
        pod = Pod(manifest, f"10.77.8.{number}", self.folder / f"pod-{number}", f"{self.name}-{number}")
        pod.folder.mkdir()
        for command in (
            f"netns add {pod.namespace}",
            f"-n {self.name} link add v{number} type veth peer name eth0 netns {pod.namespace}",
            f"-n {self.name} link set v{number} master pods up",
            f"-n {pod.namespace} link set lo up",
            f"-n {pod.namespace} addr add {pod.address}/24 dev eth0",
            f"-n {pod.namespace} link set eth0 up",
            f"-n {pod.namespace} route add default dev eth0",
        ):
            _ip(command)
        self.pods.append(pod)
        return pod

    def remove(self, pod: Pod) -> None:
        """End a pod at once."""
        pod.kill()
        _ip(f"netns del {pod.namespace}")
        self.pods.remove(pod)


@contextmanager
def network(folder: Path) -> Iterator[Network]:
    """A network for pods."""
    net = Network(f"t6gps-k8s-{os.getpid()}", folder)
    _ip(f"netns add {net.name}")
    try:
        _ip(f"-n {net.name} link add pods type bridge")
        _ip(f"-n {net.name} link set pods up")
        yield net
    finally:
        for pod in list(net.pods):
            net.remove(pod)
        _ip(f"netns del {net.name}")


def volume(entry: dict[str, Any], pod: Pod, claims: Path, config_maps: Mapping[str, dict[str, Any]]) -> Path:
    """The folder that a volume is."""
    if "persistentVolumeClaim" in entry:
        return claims / entry["persistentVolumeClaim"]["claimName"]
    path = pod.folder / f"volume-{entry['name']}"
    path.mkdir()
    if "configMap" in entry:
        held = config_maps[entry["configMap"]["name"]]
        for name, text in held.get("data", {}).items():
            (path / name).write_text(text)
        for name, text in held.get("binaryData", {}).items():
            (path / name).write_bytes(base64.b64decode(text))
    else:
        assert entry.get("emptyDir") == {}, entry
    return path


def _setup(root: Path, container: dict[str, Any], volumes: dict[str, Path]) -> Iterator[str]:
    """Shell commands that make a container's root of this machine's folders and its volumes."""
    own = {mount["mountPath"].split("/")[1] for mount in container.get("volumeMounts", [])}
    yield f"mount -t tmpfs none {root}"
    for entry in sorted(Path("/").iterdir()):
        here = root / entry.name
        if entry.is_symlink():
            yield f"cp -P {entry} {here}"
        elif entry.is_dir() and entry.name not in own and entry.name != "proc":
            yield f"mkdir {here} && mount --rbind {entry} {here}"
            if entry.name not in SPECIAL:
                yield f"mount -o remount,bind,ro {here}"
    yield f"mkdir {root}/proc && mount -t proc proc {root}/proc && mount -t tmpfs none {root}/dev/shm"
    for mount in container.get("volumeMounts", []):
        here = f"{root}{mount['mountPath']}"
        yield f"mkdir -p {here} && mount --bind {volumes[mount['name']]} {here}"
    for program in {REPOSITORY, Path(sys.prefix), Path(sys.base_prefix)}:
        if program.parts[1] in own:  # it would lie under a volume
            yield f"mkdir -p {root}{program} && mount --rbind {program} {root}{program}"
    for mount in container.get("volumeMounts", []):
        if mount.get("readOnly"):
            yield f"mount -o remount,bind,ro {root}{mount['mountPath']}"
    if container.get("securityContext", {}).get("readOnlyRootFilesystem"):
        yield f"mount -o remount,ro {root}"


def _with(environment: dict[str, str]) -> list[str]:
    return ["env", "--chdir=/", "-i", *(f"{name}={value}" for name, value in environment.items())]


def _ip(command: str) -> None:
    subprocess.run(["ip", *command.split()], check=True)

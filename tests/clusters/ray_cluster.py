"""A real Ray with its Jobs API, its token and its autoscaler in a network namespace: `with started(folder) as cluster`.

The head has one CPU; the autoscaler brings at most two nodes of one CPU. All that it runs ends with the context. Needs
root, iproute2 and util-linux.
"""

from __future__ import annotations

import ctypes
import os
import secrets
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from urllib.request import Request, urlopen

import yaml
from house import START_ATTEMPTS_N
from ray_nodes import HEAD, PORT, ray_start
from slurm_cluster import wait_until

PROGRAMS = ("ip", "nsenter", "unshare")
STARTED_S, ENDED_S = 300.0, 60.0
CLONE_NEWNET = 0x40000000
COMMANDS = (
    "cluster_synced_files", "rsync_exclude", "rsync_filter", "initialization_commands", "setup_commands",
    "head_setup_commands", "worker_setup_commands", "head_start_ray_commands", "worker_start_ray_commands",
)  # fmt: skip
AUTOSCALER = {
    "cluster_name": "t6gps",
    "max_workers": 2,
    "upscaling_speed": 10,
    "idle_timeout_minutes": 0.03,
    "provider": {"type": "external", "module": "ray_nodes.Nodes", "disable_node_updaters": True},
    "available_node_types": {
        "head": {"resources": {"CPU": 1}, "node_config": {}, "max_workers": 0},
        "node": {"resources": {"CPU": 1}, "node_config": {}, "min_workers": 0, "max_workers": 2},
    },
    "head_node_type": "head",
    "auth": {},
    "docker": {},
    "file_mounts": {},
    **{name: [] for name in COMMANDS},
    "file_mounts_sync_continuously": False,
}


def missing() -> list[str]:
    """Programs that this machine lacks for a cluster."""
    return [program for program in PROGRAMS if shutil.which(program) is None]


@dataclass(frozen=True)
class RayCluster:
    """A cluster that is up: the folder of its files, its namespace and its token.

    On each node FOLDER/split is a folder of the node's own.
    """

    folder: Path
    namespace: str
    token: str

    @property
    def url(self) -> str:
        return f"http://{HEAD}:8265"

    @property
    def environment(self) -> dict[str, str]:
        """Variables of whoever talks to it."""
        known = {name: value for name, value in os.environ.items() if not name.startswith(("RAY_", "T6GPS_"))}
        return known | {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": self.token}

    def enter(self, *command: str | Path) -> list[str]:
        """A command inside the namespace."""
        return ["nsenter", f"--net=/run/netns/{self.namespace}", *map(str, command)]

    def processes(self) -> list[int]:
        """Processes inside the namespace, but for this one."""
        pids = subprocess.run(["ip", "netns", "pids", self.namespace], capture_output=True, text=True, check=True)
        return [int(pid) for pid in pids.stdout.split() if int(pid) != os.getpid()]

    @contextmanager
    def inside(self) -> Iterator[None]:
        """This thread, and those that it starts, live in the namespace meanwhile."""
        with Path("/proc/thread-self/ns/net").open() as outside, Path(f"/run/netns/{self.namespace}").open() as inside:
            _enter_namespace(inside.fileno())
            try:
                yield
            finally:
                _enter_namespace(outside.fileno())

    def nodes(self) -> list[str]:
        """Addresses of the nodes that the autoscaler has brought and that run."""
        return [file.stem for file in self.folder.glob("*.pid") if Path(f"/proc/{file.read_text()}").exists()]

    def at_head(self, path: Path) -> Path:
        """A path as the head sees it."""
        return Path(f"/proc/{(self.folder / 'head').read_text()}/root{path}")

    def lose(self, node: str) -> None:
        """Kill a node."""
        os.killpg(int((self.folder / f"{node}.pid").read_text()), signal.SIGKILL)

    def up(self) -> bool:
        """True when the Jobs API answers; whoever asks is inside."""
        asked = Request(f"{self.url}/api/version", headers={"Authorization": f"Bearer {self.token}"})
        try:
            urlopen(asked, timeout=10).close()
        except OSError:
            return False
        return True


@contextmanager
def started(folder: Path) -> Iterator[RayCluster]:
    """A cluster that is up, and gone at the end with all that it ran."""
    folder.mkdir(parents=True)
    cluster = RayCluster(folder, f"t6gps-ray-{os.getpid()}", secrets.token_hex(32))
    provider = {**AUTOSCALER["provider"], "folder": str(folder)}
    (folder / "autoscaler.yaml").write_text(yaml.safe_dump({**AUTOSCALER, "provider": provider}))
    with ExitStack() as stack:
        subprocess.run(["ip", "netns", "add", cluster.namespace], check=True)
        stack.callback(subprocess.run, ["ip", "netns", "del", cluster.namespace], check=True)
        addresses = [["addr", "add", f"10.77.9.{number}/32", "dev", "lo"] for number in range(1, 10)]
        for command in (["link", "set", "lo", "up"], *addresses):
            subprocess.run(["ip", "-n", cluster.namespace, *command], check=True)
        stack.callback(_end, cluster)
        assert any(_is_up(cluster, stack) for _ in range(START_ATTEMPTS_N)), (folder / "head.log").read_text()
        yield cluster


def _is_up(cluster: RayCluster, stack: ExitStack) -> bool:
    """Start the head, and say whether it is up; it gives up when a busy machine does not start it in half a minute."""
    with (cluster.folder / "head.log").open("ab") as log:
        head = stack.enter_context(_head(cluster, log.fileno()))
    with cluster.inside():
        wait_until(lambda: cluster.up() or head.poll() is not None, STARTED_S)
    if head.poll() is not None:
        _end(cluster)
    return head.poll() is None


@contextmanager
def _head(cluster: RayCluster, log: int) -> Iterator[subprocess.Popen[bytes]]:
    """The head's process; who reads its files waits for its end."""
    options = ["--head", f"--port={PORT}", f"--dashboard-host={HEAD}"]
    options += [f"--autoscaling-config={cluster.folder}/autoscaler.yaml"]
    programs = Path(sys.executable).parent
    settings = {
        "AUTOSCALER_UPDATE_INTERVAL_S": "1",
        "RAY_health_check_initial_delay_ms": "1000",
        "RAY_health_check_period_ms": "1000",  # a node that dies is noticed within seconds
        "PATH": f"{programs}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(Path(__file__).parent),
        "RAY_worker_niceness": "0",
        "RAY_idle_worker_killing_time_threshold_ms": "300000",
    }
    command = cluster.enter(*ray_start(cluster.folder, HEAD, *options))
    environment = cluster.environment | settings
    process = subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)
    (cluster.folder / "head").write_text(str(process.pid))
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def _enter_namespace(descriptor: int) -> None:
    """Move this thread; Python has no call for it before 3.12."""
    if ctypes.CDLL(None, use_errno=True).setns(descriptor, CLONE_NEWNET) != 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))


def _end(cluster: RayCluster) -> None:
    """Kill whatever is left inside."""
    wait_until(lambda: not _killed(cluster.processes()), ENDED_S)


def _killed(pids: list[int]) -> list[int]:
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    return pids

"""Laws of a run on separate hosts: network namespaces with addresses of their own, a head and two nodes by `ray start`.

The head stands in the middle: a pair of virtual Ethernet devices leads to each node, and it forwards between them. A
host has its own /tmp/ray, as machines have. All addresses exist within the namespaces alone.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from house import QUICK_HEALTH_CHECKS, RUN, policy
from job import CONFIG

from t6gps.service import seeding
from t6gps.service.config import Config
from t6gps.service.steering import status as statuses
from t6gps.storage import catalog
from t6gps.storage.errors import RunError
from t6gps.storage.spool import Spool
from t6gps.workers import stub

ADDRESSES = {"head": "10.77.0.1", "near": "10.77.0.11", "far": "10.77.0.12"}
PORT = 6379
HERE = Path(__file__).parent
OWN_TMP = 'mount --make-rprivate / && mount --bind "$0" /tmp/ray && exec "$@"'


class Hosts:
    """Namespaces by name, joined by links, and the processes that were started in them."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.prefix = folder, f"t6gps-{os.getpid()}-"
        self.token = secrets.token_hex(32)
        self.processes: list[subprocess.Popen[bytes]] = []
        self.rays: dict[str, subprocess.Popen[bytes]] = {}
        for host in ADDRESSES:
            (folder / host).mkdir()

    def join(self) -> None:
        """Make the namespaces and the links. CalledProcessError where that is not allowed."""
        for host in ADDRESSES:
            ip("netns", "add", self.prefix + host)
            self.ip(host, "link set lo up")
        self.ip("head", f"addr add {ADDRESSES['head']}/32 dev lo")
        self.enter("head", ["sysctl", "-qw", "net.ipv4.ip_forward=1"]).wait()
        for host in ("near", "far"):
            self.ip("head", f"link add {host} type veth peer name out netns {self.prefix}{host}")
            self.ip("head", f"link set {host} up")
            self.ip("head", f"route add {ADDRESSES[host]}/32 dev {host} src {ADDRESSES['head']}")
            self.ip(host, f"addr add {ADDRESSES[host]}/32 dev out")
            self.restore(host)

    def cut(self, host: str) -> None:
        """The link to a host is dead."""
        self.ip(host, "link set out down")

    def restore(self, host: str) -> None:
        """The link to a host works."""
        self.ip(host, "link set out up")
        self.ip(host, f"route add {ADDRESSES['head']}/32 dev out")
        self.ip(host, f"route add default via {ADDRESSES['head']} dev out onlink")

    def ip(self, host: str, command: str) -> None:
        ip("-n", self.prefix + host, *command.split())

    def enter(self, host: str, command: list[str], **environment: str) -> subprocess.Popen[bytes]:
        """Start a command on a host; its output goes to a file of the host's folder."""
        known = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        known |= {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": self.token, "RAY_worker_niceness": "0"}
        known |= QUICK_HEALTH_CHECKS
        inside = ["unshare", "--mount", "sh", "-c", OWN_TMP, str(self.folder / host), *command]
        with (self.folder / f"{host}-{len(self.processes)}.log").open("wb") as log:
            started = subprocess.Popen(
                ["ip", "netns", "exec", self.prefix + host, *inside],
                stdout=log, stderr=subprocess.STDOUT, env=known | environment, start_new_session=True,
            )  # fmt: skip
        self.processes.append(started)
        return started

    def output(self, process: subprocess.Popen[bytes]) -> str:
        """Everything that a process has written."""
        (log,) = self.folder.glob(f"*-{self.processes.index(process)}.log")
        return log.read_text()

    def keep_ray(self, host: str) -> str:
        """Start Ray on a host if it does not run there, a head or a node of one CPU; what it has written.

        It ends when Ray gives the node up, or when a busy machine does not start it within Ray's half a minute.
        """
        if host not in self.rays or self.rays[host].poll() is not None:
            ray = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--disable-usage-stats"]
            ray += ["--num-cpus=1", f"--node-ip-address={ADDRESSES[host]}", f"--object-store-memory={2 * 10**8}"]
            head = ["--head", f"--port={PORT}", "--include-dashboard=false"]
            other = [f"--address={ADDRESSES['head']}:{PORT}"]
            self.rays[host] = self.enter(host, [*ray, *(head if host == "head" else other)])
        return self.output(self.rays[host])

    def run(self, *command: str, **environment: str) -> subprocess.Popen[bytes]:
        """A Python program on the head's host that joins the cluster."""
        address = {"RAY_ADDRESS": f"{ADDRESSES['head']}:{PORT}"}
        return self.enter("head", [sys.executable, *command], **(address | environment))

    def close(self) -> None:
        """End whatever runs on the hosts, and the hosts."""
        for host in ADDRESSES:
            name = self.prefix + host
            pids = subprocess.run(["ip", "netns", "pids", name], check=False, capture_output=True).stdout.split()
            for pid in pids:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(int(pid), signal.SIGKILL)
            subprocess.run(["ip", "netns", "del", name], check=False, capture_output=True)
        for process in self.processes:
            process.wait(20)


def ip(*arguments: str) -> None:
    """Run iproute2. CalledProcessError with its complaint."""
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=20)


@pytest.fixture(scope="module")
def hosts(tmp_path_factory: pytest.TempPathFactory, wait_until: Callable[..., None]) -> Iterator[Hosts]:
    joined = Hosts(tmp_path_factory.mktemp("hosts"))
    try:
        try:
            Path("/tmp/ray").mkdir(exist_ok=True)
            joined.join()
        except (OSError, subprocess.CalledProcessError) as error:
            output = getattr(error, "stderr", b"") or b""
            pytest.skip(f"network namespaces cannot be made here (root and iproute2 needed): {error} {output.decode()}")
        wait_until(lambda: "Ray runtime started" in joined.keep_ray("head"), 180)
        yield joined
    finally:
        joined.close()


REFUSED = {
    "wrong token": ({"RAY_AUTH_TOKEN": "0" * 64}, "token"),
    "no token": ({"RAY_AUTH_MODE": "disabled", "RAY_AUTH_TOKEN": ""}, "token"),
    "wrong address": ({"RAY_ADDRESS": f"{ADDRESSES['head']}:1"}, "no Ray answers at RAY_ADDRESS"),
}
"""What is wrong in the environment of who joins, and what the error says."""


@pytest.mark.slow
def test_t19_who_has_no_token_or_a_wrong_address_is_told_so_in_one_error(hosts: Hosts, tmp_path: Path) -> None:
    command = ["-m", "t6gps", "train", "flat-quick", "--root", str(tmp_path)]
    joining = {
        name: hosts.run(*command, "--run", name.replace(" ", "-"), **environment)
        for name, (environment, _) in REFUSED.items()
    }  # at once: Ray takes its time
    for name, refused in joining.items():
        assert refused.wait(300) == 2, name
        output = hosts.output(refused)
        assert sum(line.startswith("error:") for line in output.splitlines()) == 1  # Ray's own warnings stand before it
        assert REFUSED[name][1] in output
        assert "Traceback" not in output
        assert hosts.token not in output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_t16_a_run_goes_on_without_a_host_that_is_cut_off_and_with_it_when_it_is_back(
    hosts: Hosts, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    for host in ("near", "far"):
        wait_until(lambda host=host: "Ray runtime started" in hosts.keep_ray(host), 240)
    job = hosts.run(str(HERE / "job.py"), str(tmp_path))
    run = catalog.Run(tmp_path / RUN)

    def status() -> dict[str, Any]:
        assert job.poll() is None, hosts.output(job)
        try:
            return statuses.status(run)
        except RunError:
            return {"workers": [], "episodes": {"committed": 0}}

    def at_work(host: str) -> bool:
        hosts.keep_ray(host)
        return any(worker["episodes"] and worker["node"] == ADDRESSES[host] for worker in status()["workers"])

    wait_until(lambda: sum(at_work(host) for host in ADDRESSES) == len(ADDRESSES), 240)
    before = status()["episodes"]["committed"]
    hosts.cut("near")
    wait_until(lambda: not any(worker["node"] == ADDRESSES["near"] for worker in status()["workers"]), 240)
    cut = status()["episodes"]["committed"]
    wait_until(lambda: status()["episodes"]["committed"] > cut + 20, 240)
    hosts.restore("near")
    wait_until(lambda: at_work("near"), 240)  # by itself, or started again after Ray had given it up
    (tmp_path / "enough").touch()
    assert job.wait(300) == 0, hosts.output(job)
    assert cut > before
    config, ended = Config.model_validate(CONFIG), statuses.status(run)
    batches = sorted(run.spool.iterdir())
    assert ended["state"] == "DONE"
    assert ended["episodes"]["committed"] == len(batches) * config.run.episodes
    assert ended["episodes"]["failures"] == ended["episodes"]["quarantined"] == 0
    for iteration in range(len(batches)):
        episodes = Spool(run.spool, iteration).episodes()
        plans = seeding.training_plans(config, iteration)
        assert sorted(episodes) == [plan.episode_id for plan in plans]
        for plan in plans:
            alone = stub.episode(plan, policy(iteration))
            assert episodes[plan.episode_id].frames.equals(alone.frames)
            assert episodes[plan.episode_id].summary.equals(alone.summary)

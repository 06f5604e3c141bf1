"""A real Slurm of two nodes on this machine, in a network namespace of its own: `with started(folder) as cluster`.

Each node has an address of its own. All daemons end with the context, by the numbers in their files. Needs root, and
the packages slurm-wlm, munge, iproute2 and util-linux.
"""

from __future__ import annotations

import os
import secrets
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

PROGRAMS = ("sbatch", "slurmctld", "slurmd", "munged", "ip", "nsenter")
DAEMONS = ("munged", "slurmctld", "slurmd ", "slurmscriptd")
"""How the command lines of daemons begin; those that serve a step (slurmstepd) end with its job."""
NODES = ("t6n1", "t6n2")
STARTED_S, ENDED_S = 180.0, 60.0
CONFIGURATION = """\
ClusterName=t6
SlurmctldHost=localhost(127.0.0.1)
SlurmctldPort=26817
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge/socket
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool/%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/log/slurmctld.log
SlurmdLogFile={folder}/log/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SchedulerType=sched/builtin
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
JobCompType=jobcomp/none
ReturnToService=2
SlurmdTimeout=30
KillWait=5
SrunPortRange=27000-27100
NodeName=t6n[1-2] NodeHostname=localhost NodeAddr=10.77.9.[1-2] Port=[26821-26822] CPUs=2 Sockets=1 CoresPerSocket=2 \
ThreadsPerCore=1 RealMemory=4000 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def missing() -> list[str]:
    """Programs that this machine lacks for a cluster."""
    return [program for program in PROGRAMS if shutil.which(program) is None]


@dataclass(frozen=True)
class Cluster:
    """A cluster that is up: where its files lie, and the network namespace that it lives in."""

    folder: Path
    namespace: str

    @property
    def environment(self) -> dict[str, str]:
        """Variables that lead Slurm's programs to it, and its jobs to a folder for temporary files."""
        return {**os.environ, "SLURM_CONF": str(self.folder / "slurm.conf"), "TMPDIR": str(self.folder / "t")}

    def call(self, *command: str | Path) -> subprocess.CompletedProcess[str]:
        """A command inside the namespace, with the programs of Slurm at hand."""
        inside = ["nsenter", f"--net=/run/netns/{self.namespace}", *map(str, command)]
        return subprocess.run(inside, env=self.environment, capture_output=True, text=True, check=False)

    def asked(self, *command: str | Path) -> str:
        """What a command inside the namespace prints; it must succeed."""
        done = self.call(*command)
        assert done.returncode == 0, f"{command}: {done.stderr}{done.stdout}"
        return done.stdout

    def processes(self) -> set[int]:
        """Processes inside the namespace that have not ended."""
        pids = subprocess.run(["ip", "netns", "pids", self.namespace], capture_output=True, text=True, check=True)
        return {int(pid) for pid in pids.stdout.split() if _alive(int(pid))}

    def of_jobs(self) -> set[int]:
        """Processes of jobs: all but the daemons."""
        return {pid for pid in self.processes() if not _command(pid).startswith(DAEMONS)}


@contextmanager
def started(folder: Path) -> Iterator[Cluster]:
    """A cluster that is up, and down again at the end with all that it ran."""
    for name in ("munge", "state", "log", "t", *(f"spool/{node}" for node in NODES)):
        (folder / name).mkdir(parents=True)
    (folder / "munge").chmod(0o755)
    _write(folder / "munge" / "key", secrets.token_hex(512), 0o600)
    _write(folder / "slurm.conf", CONFIGURATION.format(folder=folder), 0o644)
    _write(folder / "cgroup.conf", "CgroupPlugin=cgroup/v1\n", 0o644)
    cluster = Cluster(folder, f"t6gps-slurm-{os.getpid()}")
    with ExitStack() as stack:
        _network(cluster, stack)
        stack.callback(_end, cluster)
        munge = folder / "munge"
        files = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
        cluster.asked("munged", "--force", *(f"--{option}={munge / name}" for option, name in files.items()))
        cluster.asked("slurmctld", "-c")
        for node in NODES:
            cluster.asked("slurmd", "-N", node)
        wait_until(lambda: cluster.asked("sinfo", "-h", "-N", "-o", "%T").split() == ["idle"] * len(NODES), STARTED_S)
        yield cluster


def wait_until(condition: Callable[[], bool], seconds: float) -> None:
    """Return as soon as a condition holds; an error when it does not by then."""
    assert _becomes(condition, seconds), f"still not so after {seconds} s"


def _becomes(condition: Callable[[], bool], seconds: float) -> bool:
    """Wait until a condition holds, and say whether it does by then."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)  # other processes bring the condition about: there is nothing to wait on but the clock
    return True


def _network(cluster: Cluster, stack: ExitStack) -> None:
    """A namespace with loopback, and an address of each node on it."""
    subprocess.run(["ip", "netns", "add", cluster.namespace], check=True)
    stack.callback(subprocess.run, ["ip", "netns", "del", cluster.namespace], check=True)
    addresses = [["addr", "add", f"10.77.9.{number}/32", "dev", "lo"] for number in (1, 2)]
    for command in (["link", "set", "lo", "up"], *addresses):
        subprocess.run(["ip", "-n", cluster.namespace, *command], check=True)


def _end(cluster: Cluster) -> None:
    """End the jobs, then the daemons, then whatever is left."""
    cluster.call("scancel", "--full", "--signal=KILL", "--state=RUNNING")
    cluster.call("scancel", "--state=PENDING")
    _becomes(lambda: not cluster.of_jobs(), ENDED_S)
    cluster.call("scontrol", "shutdown")
    munge = cluster.folder / "munge" / "pid"
    if munge.exists():
        os.kill(_number(munge), signal.SIGTERM)
    _becomes(lambda: not cluster.processes(), ENDED_S)
    for pid in cluster.processes():
        os.kill(pid, signal.SIGKILL)


def _write(path: Path, text: str, mode: int) -> None:
    path.write_text(text)
    path.chmod(mode)


def _number(path: Path) -> int:
    return int(path.read_text())


def _command(pid: int) -> str:
    """The command line of a process, or the title that it gave itself; empty when it has ended."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip(" :")
    except (FileNotFoundError, ProcessLookupError):
        return ""


def _alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False

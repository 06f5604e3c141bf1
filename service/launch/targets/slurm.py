"""Jobs on a Slurm cluster, by its own programs: sbatch, squeue, scancel, scontrol."""

from __future__ import annotations

import shlex
import subprocess
from collections.abc import Sequence
from contextlib import AbstractContextManager
from importlib import resources
from importlib.resources import as_file
from pathlib import Path

from t6gps.service.config import Config
from t6gps.service.launch.folder import Planned
from t6gps.service.launch.job import STOPPED, Job, JobState, outcome
from t6gps.service.launch.target import Slurm
from t6gps.service.launch.targets.visible import VisibleLauncher, check_publishing
from t6gps.storage.errors import ConfigError, RunError

PROGRAMS = ("sbatch", "squeue", "scancel", "scontrol")
ANSWER_S = 60.0
"""How long the cluster's controller has to answer; its programs try for some time by themselves."""
WAITING = ("PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SUSPENDED", "RESV_DEL_HOLD")
ALIVE = ("RUNNING", "COMPLETING", "SIGNALING", "STAGE_OUT", "STOPPED", "RESIZING")
"""Slurm's words for jobs that are still there, before and after they have nodes."""
UNKNOWN = "Invalid job id"
"""What Slurm says of a job that it has forgotten."""


class SlurmLauncher(VisibleLauncher):
    """The launcher of a Slurm cluster whose nodes share the root with this machine. A job's number is Slurm's."""

    def __init__(self, target: Slurm) -> None:
        self.target = target

    def check(self, planned: Sequence[Planned]) -> None:
        _fits(planned[0].config, self.target)
        check_publishing(planned)
        for program in PROGRAMS:
            _asked(program, "--version")
        _asked("scontrol", "ping")
        with _script() as script:
            _asked("sbatch", "--test-only", *_options(self.target), str(script), remedy="correct the file of targets")

    def render(self, planned: Sequence[Planned]) -> str:
        with _script() as script:
            call = shlex.join(["sbatch", *self._arguments(planned, script)])
            return f"{call}\n\n# {script.name}\n{script.read_text()}"

    def submit(self, planned: Sequence[Planned]) -> list[str]:
        with _script() as script:
            number = _asked("sbatch", *self._arguments(planned, script)).strip().partition(";")[0]
        if len(planned) == 1:
            return [number]
        return [f"{number}_{task}" for task in range(len(planned))]

    def state(self, job: Job) -> tuple[JobState, str]:
        try:
            said = _asked("squeue", "--noheader", "--array", f"--jobs={job.native_id}", "--format=%T|%r|%N").strip()
        except RunError as error:
            if UNKNOWN not in str(error):
                raise
            said = ""
        word, _, rest = said.partition("|")
        reason, _, nodes = rest.partition("|")
        if word in WAITING:
            return JobState.PENDING, reason
        if word in ALIVE:
            return JobState.RUNNING, f"on {nodes}"
        return outcome(job.folder)

    def stop(self, job: Job) -> None:
        if self.state(job)[0] is JobState.PENDING:  # nothing runs that could stop, or say so
            self.cancel(job)
            job.folder.end(STOPPED)
        else:  # to the script alone, which stops the run; Slurm would send it to Ray first
            _cancelled("--batch", "--signal=TERM", job.native_id)

    def cancel(self, job: Job) -> None:
        _cancelled(job.native_id)

    def _arguments(self, planned: Sequence[Planned], script: Path) -> list[str]:
        """What follows `sbatch`: one job, or an array with a task for each folder, named RUN-seedTASK."""
        folders = [job.folder for job in planned]
        first, several = folders[0], len(folders) > 1
        log = first.log.parent.with_name(first.run.removesuffix("0") + "%a") / "log" if several else first.log
        array = [f"--array=0-{len(folders) - 1}"] if several else []
        outputs = ["--parsable", f"--output={log}", f"--chdir={first.root}"]
        if planned[0].publish is not None:
            outputs.append("--export=ALL")  # the keys of the object store, also where the site takes nothing along
        paths = [str(folder.path) for folder in folders]
        return [*outputs, *array, *_options(self.target), str(script), self.target.bin, *paths]


def _script() -> AbstractContextManager[Path]:
    return as_file(resources.files("t6gps.deploy") / "slurm" / "train.sbatch")


def _options(target: Slurm) -> list[str]:
    """The target in the words of sbatch."""
    chosen = {
        "partition": target.partition,
        "account": target.account,
        "qos": target.qos,
        "nodes": target.nodes,
        "cpus-per-task": target.cpus_per_node,
        "mem": None if target.memory_mb_per_node is None else f"{target.memory_mb_per_node}M",
        "time": target.minutes,
    }
    return [f"--{name}={value}" for name, value in chosen.items() if value is not None]


def _fits(config: Config, target: Slurm) -> None:
    """ConfigError for more workers than the nodes have CPUs: some would never start."""
    size = config.run
    workers_n = max(size.workers, *(size.autoscale or (0,)))
    each_n = int(target.cpus_per_node / size.cpus_per_worker + 1e-6)
    if workers_n > target.nodes * each_n:
        raise ConfigError(
            f"{workers_n} workers of run.cpus_per_worker = {size.cpus_per_worker:g} do not fit on slurm.nodes = "
            f"{target.nodes} with slurm.cpus_per_node = {target.cpus_per_node}; allowed: {target.nodes * each_n}; "
            "lower --workers, or ask for more in the file of targets"
        )


def _cancelled(*arguments: str) -> None:
    """Call scancel for a job that may have ended just now."""
    try:
        _asked("scancel", *arguments)
    except RunError as error:
        if UNKNOWN not in str(error) and "already completing" not in str(error):
            raise


def _asked(program: str, *arguments: str, remedy: str = "see that the cluster works with sinfo") -> str:
    """What a program of Slurm prints. RunError where it is missing, fails, or gets no answer."""
    try:
        done = subprocess.run(
            [program, *arguments],
            capture_output=True, text=True, timeout=ANSWER_S, check=False, stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except FileNotFoundError:
        raise RunError(
            f"there is no program {program} on this machine; submit from a login node of the cluster, or add Slurm's "
            "programs to PATH"
        ) from None
    except subprocess.TimeoutExpired:
        raise RunError(f"Slurm's controller has not answered {program} within {ANSWER_S:.0f} s; {remedy}") from None
    said = " ".join(done.stderr.split())
    if done.returncode != 0 or (arguments == ("ping",) and "UP" not in done.stdout):
        raise RunError(f"Slurm refused {program}: {said or done.stdout.strip()}; {remedy}")
    return done.stdout

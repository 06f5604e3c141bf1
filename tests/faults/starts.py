"""Every way of starting ends: under each condition a run trains, or one sentence names cause and remedy.

    python tests/faults/starts.py [--json] [PATTERN]

Starts a small training under each condition whose name holds PATTERN. Stops one in each of its phases, by SIGTERM, by
Ctrl-C and by `t6gps stop`.
Prints what came of it and how long it took; with --json as docs/figures/starts.json has it. Conditions that this
machine cannot make are passed over with a word. `test_starts.py` runs some of them.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import date
from itertools import product
from pathlib import Path

from t6gps.service import provenance
from t6gps.service.ray_backend import processes
from t6gps.service.steering import requests
from t6gps.storage import catalog

DEADLINE_S, STOP_DEADLINE_S, GONE_DEADLINE_S = 60.0, 5.0, 10.0
"""For a refusal; for a stop; for the last process of a run that has ended."""
PATIENCE_S = 300.0
"""For a training."""
TINY = ["run.iterations=2", "run.episodes=4", "run.steps=50", "run.evaluation_episodes=2"]
PROGRAM = [str(Path(sys.executable).with_name("t6gps"))]
TRAIN = ["train", "flat-quick", "--run", "one", *(f"--set={setting}" for setting in TINY)]
LONG = "x" * 60
SHADOWS = ("numpy.py", "ray.py", "typer.py", "pyarrow.py")
TRAINS = "trains"
MARK = "T6GPS_STARTED_BY"
"""Variable that all processes of a start inherit."""

PLAIN = 'exec "$@"'
BUSY = 'for i in $(seq $((4 * $(nproc)))); do (while :; do :; done) & done; "$@"; code=$?; kill $(jobs -p); exit $code'
HIDE = f"for f in {' '.join(SHADOWS)}; do echo 1/0 > $f; done; {PLAIN}"
SERVE = f"""{sys.executable} -m http.server --bind 127.0.0.1 18099 > /dev/null 2>&1 &
until (: < /dev/tcp/127.0.0.1/18099) 2> /dev/null; do sleep 0.1; done
"$@"; code=$?; kill $!; exit $code"""
IN_MOUNTS = """exec unshare -rm sh -c '{} && exec "$@"' sh "$@" """
FILL = "until test -e runs/one/config.json; do sleep 0.05; done; cat /dev/zero > runs/filler"


@dataclass(frozen=True)
class Condition:
    """What is out of the ordinary.

    script        shell that runs the command "$@" in a folder of its own
    says          regular expression of the sentence; TRAINS where the run is to train
    needs         commands that must succeed here for it
    environment   variables; None takes one away
    tested        the suite has it, too
    """

    name: str
    script: str = PLAIN
    says: str = TRAINS
    needs: str = "true"
    environment: Mapping[str, str | None] = field(default_factory=dict)
    program: list[str] = field(default_factory=lambda: PROGRAM)
    tested: bool = False


NET, MOUNT = "unshare -rn true", "unshare -rm mount -t tmpfs none /mnt"
CONDITIONS = (
    Condition("nothing out of the ordinary"),
    Condition(
        "no loopback interface", 'exec unshare -rn "$@"', r"loopback.*ip link set lo up.*--serial", NET, tested=True
    ),
    Condition("a long TMPDIR", f'mkdir {LONG}; TMPDIR=$PWD/{LONG} exec "$@"'),
    Condition("a TMPDIR that is not there", 'TMPDIR=$PWD/none/none exec "$@"'),
    Condition("at most 64 open files", 'ulimit -n 64; exec "$@"', r"open files: 64; needed.*ulimit -n", tested=True),
    Condition("at most 256 open files", 'ulimit -n 256; exec "$@"'),
    Condition("at most 1,024 open files", 'ulimit -n 1024; exec "$@"'),
    Condition("a soft limit of 64 open files", 'ulimit -Sn 64; exec "$@"'),
    Condition("64 MiB of shared memory", IN_MOUNTS.format("mount -t tmpfs -o size=64m none /dev/shm"), needs=MOUNT),
    Condition("no /dev/shm", IN_MOUNTS.format("mount -t tmpfs -o ro none /dev/shm"), needs=MOUNT),
    Condition("modules in the working folder that hide others", HIDE, tested=True),
    Condition("the same, with python -m t6gps", HIDE, program=[sys.executable, "-m", "t6gps"]),
    Condition("RAY_ADDRESS empty", environment={"RAY_ADDRESS": ""}),
    Condition("RAY_ADDRESS=local", environment={"RAY_ADDRESS": "local"}),
    Condition(
        "RAY_ADDRESS where nobody listens",
        says=r"no Ray answers at RAY_ADDRESS=127\.0\.0\.1:1 .*ray start --head",
        environment={"RAY_ADDRESS": "127.0.0.1:1"},
        tested=True,
    ),
    Condition(
        "RAY_ADDRESS of another server",
        SERVE,
        r"the cluster at RAY_ADDRESS=127\.0\.0\.1:18099 could not be joined",
        environment={"RAY_ADDRESS": "127.0.0.1:18099"},
    ),
    Condition(
        "RAY_ADDRESS=ray://...",
        says=r"without ray://",
        environment={"RAY_ADDRESS": "ray://127.0.0.1:10001"},
        tested=True,
    ),
    Condition(
        "RAY_ADDRESS=auto without a cluster",
        'TMPDIR=$PWD exec unshare -rpf --mount-proc "$@"',  # Ray looks there, and at all processes of the machine
        says=r"ray start --head.*unset",
        needs="unshare -rpf --mount-proc true",
        environment={"RAY_ADDRESS": "auto"},
    ),
    Condition(
        "a full disk",
        IN_MOUNTS.format("mkdir runs && mount -t tmpfs -o size=1m none runs"),
        r"root.*runs with \d+ MiB free.*the disk is full",
        MOUNT,
    ),
    Condition(
        "a disk that fills during the run",
        IN_MOUNTS.format("mkdir runs && mount -t tmpfs -o size=48m none runs && { (" + FILL + ") 2>/dev/null & }"),
        r"runs.*[Nn]o space left.*the disk is full",
        MOUNT,
    ),
    Condition(
        "a root that cannot be written",
        IN_MOUNTS.format("mkdir runs && mount -t tmpfs -o ro none runs"),
        r"root.*Read-only file system.*the file system is read-only",
        MOUNT,
    ),
    Condition("no HOME", environment={"HOME": None}),
    Condition("a HOME that cannot be written", environment={"HOME": "/proc/1"}),
    Condition("PYTHONOPTIMIZE=1", environment={"PYTHONOPTIMIZE": "1"}),
    Condition("PYTHONOPTIMIZE=2", environment={"PYTHONOPTIMIZE": "2"}),
    Condition("standard input closed", 'exec "$@" <&-'),
    Condition("standard output closed", 'exec "$@" >&-'),
    Condition("standard error closed", 'exec "$@" 2>&-'),
    Condition("all three closed", 'exec "$@" <&- >&- 2>&-', tested=True),
    Condition(
        "an ASCII locale", environment={"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONIOENCODING": "ascii", "LANG": None}
    ),
    Condition("four busy processes on each core", BUSY),
)


@dataclass(frozen=True)
class Outcome:
    """What came of a start: its last sentence, seconds, and what is wrong with it (empty where it is right)."""

    name: str
    said: str
    took_s: float
    wrong: str


def possible(condition: Condition) -> bool:
    """True when this machine can make the condition."""
    found = subprocess.run(["sh", "-c", condition.needs], check=False, capture_output=True, timeout=60)
    return found.returncode == 0


@contextmanager
def launched(condition: Condition, folder: Path) -> Iterator[tuple[subprocess.Popen[bytes], str]]:
    """The command under the condition, and the mark of its processes; nothing of it is left at the end.

    It heeds Ctrl-C, which a shell's background jobs do not.
    """
    mark = uuid.uuid4().hex
    known = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    changed = known | {MARK: mark} | {n: v for n, v in condition.environment.items() if v is not None}
    environment = {n: v for n, v in changed.items() if condition.environment.get(n, "") is not None}
    command = ["bash", "-c", condition.script, "bash", *condition.program, *TRAIN]
    with (folder / "said").open("wb") as said:
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=said, stderr=said,
            start_new_session=True, preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509
        )  # fmt: skip
    try:
        yield process, mark
    finally:
        for pid in marked(mark):
            os.kill(pid, signal.SIGKILL)
        process.wait(20)


def marked(mark: str) -> list[int]:
    """Processes that inherited the mark and still run."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            if f"{MARK}={mark}".encode() in (path / "environ").read_bytes() and processes.command(int(path.name)):
                found.append(int(path.name))
        except OSError:
            continue  # it has ended meanwhile
    return found


def start(condition: Condition, folder: Path) -> Outcome:
    """Start a training under the condition and judge how it ends."""
    begun_s = time.monotonic()
    with launched(condition, folder) as (process, mark):
        try:
            code = process.wait(PATIENCE_S if condition.says == TRAINS else DEADLINE_S)
        except subprocess.TimeoutExpired:
            return Outcome(condition.name, "", time.monotonic() - begun_s, "it does not end")
        took_s = time.monotonic() - begun_s
        text = (folder / "said").read_text(errors="replace")
        said = TRAINS if code == 0 else sentence(text, folder)
        wrong = fault(condition, code, said, folder) or left_over(mark)
    return Outcome(condition.name, said, took_s, wrong and f"{wrong}: {text[-1500:]}")


def fault(condition: Condition, code: int, said: str, folder: Path) -> str:
    """What is wrong with how a start ended, empty where nothing is."""
    if condition.says == TRAINS:
        trained = (folder / "runs" / "one" / "evaluation.json").exists()
        return "" if code == 0 and trained else f"it ended with {code}"
    if code != 2 or not re.search(condition.says, said, re.DOTALL):
        return f"it ended with {code} and said {said!r}"
    return "a run that could not start is left" if (folder / "runs" / "one").exists() else ""


def sentence(text: str, folder: Path) -> str:
    """The error, on one line and without names of this machine."""
    line = " ".join(text.rpartition("error: ")[2].split())
    return re.sub(r"t6gps-\w+", "folder", line.replace(f"{folder}/", "").replace(str(folder), "."))


def left_over(mark: str) -> str:
    """Names the processes that are still there a while after the end, empty when there are none."""
    deadline = time.monotonic() + GONE_DEADLINE_S
    while (left := marked(mark)) and time.monotonic() < deadline:
        time.sleep(0.1)
    return f"left: {[processes.command(pid)[:80] for pid in left]}" if left else ""


def has_process(name: str) -> Callable[[str, Path], bool]:
    """A phase that begins with a process."""
    return lambda mark, _: any(name in processes.command(pid) for pid in marked(mark))


CLOSING = "while it closes and draws"
"""The run is done, and only its process is not: there is nothing left for `t6gps stop`."""
PHASES: dict[str, Callable[[str, Path], bool]] = {
    "while Ray starts": has_process("gcs_server"),
    "while the policy server and the workers start": has_process("ray::"),
    "while the learner starts": has_process("LearnerActor"),
    "while episodes are sampled": lambda _, run: any(run.glob("spool/*/episode-*")),
    "while the learner works": lambda _, run: any(run.glob("checkpoints/*1*")),
    "during the evaluation": lambda _, run: any(run.glob("checkpoints/*2*")),
    CLOSING: lambda _, run: (run / "evaluation.json").exists(),
}


WAYS: dict[str, Callable[[subprocess.Popen[bytes], Path], object]] = {
    "SIGTERM": lambda process, _: process.send_signal(signal.SIGTERM),
    "Ctrl-C": lambda process, _: process.send_signal(signal.SIGINT),
    "t6gps stop": lambda _, run: requests.stop(catalog.Run(run)),
}


def stop(way: str, phase: str, folder: Path) -> Outcome:
    """Stop a training in a phase, and judge how it ends."""
    condition, name = Condition(phase), f"{way} {phase}"
    with launched(condition, folder) as (process, mark):
        deadline = time.monotonic() + PATIENCE_S
        while not PHASES[phase](mark, folder / "runs" / "one"):
            if process.poll() is not None or time.monotonic() > deadline:
                return Outcome(name, "", 0.0, "the phase never came: " + (folder / "said").read_text()[-1500:])
            time.sleep(0.005)
        sent_s = time.monotonic()
        WAYS[way](process, folder / "runs" / "one")
        try:
            code = process.wait(DEADLINE_S)
        except subprocess.TimeoutExpired:
            return Outcome(name, "", time.monotonic() - sent_s, "it does not end")
        took_s = time.monotonic() - sent_s
        text = (folder / "said").read_text(errors="replace")
        wrong = "" if code in (0, 130) and "Traceback" not in text else f"it ended with {code}: {text[-1500:]}"
        wrong = wrong or ("" if took_s < STOP_DEADLINE_S else "too late") or left_over(mark)
        kept = (folder / "runs" / "one").exists()
    return Outcome(name, "ends, and keeps the run" if kept else "ends, and leaves no run", took_s, wrong)


def outcomes(pattern: str) -> Iterator[Outcome]:
    for condition in CONDITIONS:
        if pattern not in condition.name:
            continue
        if not possible(condition):
            print(f"{condition.name}: this machine cannot make it ({condition.needs})", file=sys.stderr)
            continue
        yield in_folder(lambda folder, condition=condition: start(condition, folder))
    for way, phase in product(WAYS, PHASES):
        if pattern in f"{way} {phase}" and (way, phase) != ("t6gps stop", CLOSING):
            yield in_folder(lambda folder, way=way, phase=phase: stop(way, phase, folder))


def in_folder(judge: Callable[[Path], Outcome]) -> Outcome:
    folder = Path(tempfile.mkdtemp(prefix="t6gps-"))
    try:
        return judge(folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def measurement(found: list[Outcome]) -> dict[str, object]:
    """What docs/figures/starts.json holds."""
    origin = provenance.provenance()
    return {
        "command": "python tests/faults/starts.py --json",
        "commit": origin.commit,
        "machine": f"{origin.cores} cores",
        "date": date.today().isoformat(),
        "columns": [{"name": "condition"}, {"name": "what happens"}, {"name": "s", "digits": 1}],
        "rows": [[each.name, each.said, round(each.took_s, 1)] for each in found],
    }


def main(arguments: list[str]) -> int:
    pattern = "".join(argument for argument in arguments if argument != "--json")
    found = []
    for outcome in outcomes(pattern):
        found.append(outcome)
        verdict = f"WRONG, {outcome.wrong}" if outcome.wrong else "as it should"
        print(f"{outcome.name}: {outcome.said} ({outcome.took_s:.1f} s): {verdict}", file=sys.stderr, flush=True)
    if "--json" in arguments:
        print(json.dumps(measurement(found), indent=2))
    return int(any(outcome.wrong for outcome in found))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

"""What a run needs of the machine, checked before it starts, and by `t6gps doctor`.

Every start looks for what would make it fail: the sentence then names the very cause, where Ray would wait in vain or
say something else. `t6gps doctor` looks at everything.
"""

from __future__ import annotations

import importlib
import os
import resource
import socket
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path

from t6gps.service import advice, machine
from t6gps.service.machine import MEBIBYTE
from t6gps.storage.errors import RunError, T6GpsError

ANSWER_DEADLINE_S = 10.0
"""How long the head of a cluster has to answer."""
ROOT_BYTES = 32 * MEBIBYTE
"""For the episodes of one iteration, and their tables."""
MEMORY_BYTES, MEMORY_PER_WORKER_BYTES = 1024 * MEBIBYTE, 256 * MEBIBYTE
"""For Ray, the learner and the supervisor; for each worker."""
NATIVE = ("pybullet", "pyarrow", "duckdb", "deltalake", "torch", "sklearn", "ray._raylet")
OWN_NATIVE = (
    "t6gps.workers.physics.bullet_engine",  # with it, what hooks into Bullet
    "t6gps.workers.physics._observer",
    "t6gps.workers.episode._policy",
    "t6gps.learner._backward",
)
LOCAL_ADDRESSES = ("", "local")
"""Values of RAY_ADDRESS that mean what its absence means, as for Ray."""


@dataclass(frozen=True)
class Wanted:
    """What is to be started: so many workers, for runs below `root`."""

    workers: int
    root: Path = Path()


@dataclass(frozen=True)
class Finding:
    """What a check has found. `remedy` is empty where all is well; `stops` says that no run starts like this."""

    check: str
    found: str
    needed: str
    remedy: str = ""
    stops: bool = True

    @property
    def good(self) -> bool:
        return not self.remedy


Check = Callable[[Wanted], Finding]


def require(checks: Iterable[Check], wanted: Wanted) -> None:
    """RunError with the first finding that stops a start."""
    for check in checks:
        finding = check(wanted)
        if finding.stops and not finding.good:
            raise RunError(f"{finding.check}: {finding.found}; needed: {finding.needed}; {finding.remedy}")


def look(wanted: Wanted) -> list[Finding]:
    """What all checks find. What matters to a Ray of one's own alone stops no start where RAY_ADDRESS names another."""
    joins = cluster_address() is not None
    return [
        replace(check(wanted), stops=False) if joins and check in OWN_RAY and check not in CLUSTER else check(wanted)
        for check in ALL
    ]


def cluster_address() -> str | None:
    """The head of the cluster that RAY_ADDRESS names, None for a Ray of one's own on this machine."""
    address = os.environ.get("RAY_ADDRESS", "")
    return None if address in LOCAL_ADDRESSES else address


def root_folder(wanted: Wanted) -> Finding:
    """The root, or the folder that it is to be made in, takes files, and has room for some."""
    needed = f"a writable folder with {ROOT_BYTES // MEBIBYTE} MiB free, not in a session folder of Ray"
    folder = wanted.root.absolute()
    if any(machine.RAY_SESSION.fullmatch(part) for part in Path(os.path.realpath(folder)).parts):
        return Finding("root", str(folder), needed, "choose a --root elsewhere: Ray's folder goes with its session")
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    try:
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"0")
    except OSError as error:
        number = error.errno
        return Finding("root", f"{folder}: {error.strerror}", needed, advice.remedy(number) or "choose another --root")
    free = machine.free_bytes(folder)
    full = free < ROOT_BYTES
    return Finding("root", f"{folder} with {free // MEBIBYTE} MiB free", needed, advice.FULL if full else "")


def loopback(_: Wanted) -> Finding:
    """Processes of this machine reach one another: there is a way to the loopback address. Nothing is sent."""
    needed = "connections to 127.0.0.1"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as nobody:
            nobody.connect(("127.0.0.1", 9))
    except OSError as error:
        remedy = "bring the loopback interface up (ip link set lo up), or use --serial"
        return Finding("loopback", f"none ({error.strerror or error})", needed, remedy)
    return Finding("loopback", "connections to 127.0.0.1", needed)


def temporary_folder(_: Wanted) -> Finding:
    """Ray has a place for its sockets and logs."""
    longest = machine.SOCKET_PATH_BYTES - len(machine.SOCKET_BELOW)
    needed = f"a writable folder of at most {longest} bytes, {machine.TEMPORARY_BYTES // MEBIBYTE} MiB free"
    folder = machine.temporary_folder()
    if folder is None:
        faults = "; ".join(dict.fromkeys(machine.fault_of(each) for each in machine.temporary_folders()))
        return Finding("temporary folder", f"none ({faults})", needed, "name one by RAY_TMPDIR, or use --serial")
    return Finding("temporary folder", str(folder), needed)


def shared_memory(_: Wanted) -> Finding:
    """Ray's object store has room, in shared memory or on disk."""
    least = machine.LEAST_STORE_BYTES // MEBIBYTE
    needed = f"{machine.STORE_BYTES // MEBIBYTE} MiB, at least {least}"
    folder = machine.temporary_folder()
    if folder is None:
        return Finding("object store", "no temporary folder", needed, "mend that first")
    store = machine.object_store(folder)
    found = f"{store.nbytes // MEBIBYTE} MiB in {store.folder}"
    if store.nbytes < machine.LEAST_STORE_BYTES:
        remedy = f"make room in {machine.SHARED} (docker run --shm-size=3g) or in {folder}, or use --serial"
        return Finding("object store", found, needed, remedy)
    slow = store.folder != machine.SHARED
    remedy = f"a file on disk is slower: make room in {machine.SHARED} (docker run --shm-size=3g)" if slow else ""
    return Finding("object store", found, needed, remedy, stops=False)


def descriptors(wanted: Wanted) -> Finding:
    """Processes may open enough files; the soft limit does not matter, a start raises it."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed_n = machine.descriptors_needed_n(wanted.workers)
    most = "unlimited" if hard == resource.RLIM_INFINITY else str(hard)
    few = hard != resource.RLIM_INFINITY and hard < needed_n
    remedy = f"raise the hard limit (ulimit -n {needed_n}, or nofile in limits.conf), or use --serial" if few else ""
    return Finding("open files", most, f"{needed_n} for {wanted.workers} workers", remedy)


def home(_: Wanted) -> Finding:
    """Matplotlib and others keep caches there; without it they do so elsewhere, each time anew."""
    needed = "a writable folder"
    folder = Path(os.environ.get("HOME", ""))
    if not os.environ.get("HOME"):
        return Finding("HOME", "not set", needed, "set HOME: programs start slower without their caches", stops=False)
    good = os.access(folder, os.W_OK | os.X_OK)
    remedy = "" if good else "give access to it: programs start slower without their caches"
    return Finding("HOME", str(folder) if good else f"{folder}, not writable", needed, remedy, stops=False)


def cores(wanted: Wanted) -> Finding:
    """Each worker keeps a core busy."""
    found_n = len(os.sched_getaffinity(0))
    remedy = f"ask for --workers {found_n}: more do not sample faster" if found_n < wanted.workers else ""
    return Finding("cores", str(found_n), f"{wanted.workers}, one for each worker", remedy, stops=False)


def memory(wanted: Wanted) -> Finding:
    """The processes of a run fit."""
    needed = MEMORY_BYTES + MEMORY_PER_WORKER_BYTES * wanted.workers
    found = min(machine.available_bytes(), machine.memory_bytes())
    remedy = "end other programs, or ask for fewer --workers" if found < needed else ""
    words = f"{found // MEBIBYTE} MiB available", f"{needed // MEBIBYTE} MiB for {wanted.workers} workers"
    return Finding("memory", *words, remedy, stops=False)


def versions(_: Wanted) -> Finding:
    """Libraries have the versions that this package was tested with, as its own metadata name them."""
    differing = []
    for requirement in metadata.requires("t6gps") or ():
        pin, extra, _condition = requirement.partition(";")
        name, _equal, version = pin.partition("==")
        if extra:
            continue
        try:
            found = metadata.version(name.strip())
        except metadata.PackageNotFoundError:
            found = "none"
        if found.partition("+")[0] != version.strip():
            differing.append(f"{name.strip()} {found} for {version.strip()}")
    words = ", ".join(differing) or "the pinned versions"
    return Finding("versions", words, "the pinned versions", "install t6gps anew with pip" if differing else "")


def native_libraries(_: Wanted) -> Finding:
    """What is compiled can be loaded."""
    faults = []
    for name in (*NATIVE, *OWN_NATIVE):
        try:
            importlib.import_module(name)
        except (ImportError, OSError, T6GpsError) as error:
            faults.append(f"{name}: {error}")
    remedy = "install t6gps anew with pip, for this Python and machine" if faults else ""
    count = len(NATIVE) + len(OWN_NATIVE)
    return Finding("native libraries", "; ".join(faults) or f"{count} loaded", "all can be loaded", remedy)


def films(_: Wanted) -> Finding:
    """`t6gps render` finds its encoder."""
    try:
        found, remedy = importlib.import_module("imageio_ffmpeg").get_ffmpeg_exe(), ""
    except (ImportError, RuntimeError) as error:
        found, remedy = f"none ({error})", "install imageio-ffmpeg anew; without it there are no films"
    return Finding("films", found, "an ffmpeg", remedy, stops=False)


def optimised(_: Wanted) -> Finding:
    """Python keeps docstrings, which Ray's own processes need; a start takes care of those."""
    level = sys.flags.optimize
    remedy = "unset PYTHONOPTIMIZE: the help of the commands is lost" if level > 1 else ""
    return Finding("Python's optimisation", str(level), "0 or 1", remedy, stops=False)


def cluster(_: Wanted) -> Finding:
    """Somebody listens where RAY_ADDRESS says."""
    needed = "HOST:PORT of a cluster's head, or auto"
    address = cluster_address()
    if address is None:
        return Finding("RAY_ADDRESS", "none: a run starts a Ray of its own", needed)
    if address == "auto":
        return Finding("RAY_ADDRESS", "auto", needed)
    if address.startswith("ray://"):
        remedy = "take the head's own port (6379), without ray://: Ray Client is not used"
        return Finding("RAY_ADDRESS", repr(address), needed, remedy)
    host, colon, port = address.rpartition(":")
    if not (colon and host and port.isdecimal()) or "://" in address:
        return Finding("RAY_ADDRESS", repr(address), needed, "correct it, or unset it to use this machine alone")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_DEADLINE_S).close()
    except (OSError, OverflowError) as error:
        remedy = "start its head (ray start --head), correct the address, or unset it to use this machine alone"
        return Finding("RAY_ADDRESS", f"no Ray answers at RAY_ADDRESS={address} ({error})", needed, remedy)
    return Finding("RAY_ADDRESS", f"{address} answers", needed)


OWN_RAY: tuple[Check, ...] = (loopback, temporary_folder, shared_memory, descriptors)
"""For a start of a Ray of one's own."""
CLUSTER: tuple[Check, ...] = (cluster, descriptors)
"""For joining one."""
ALL: tuple[Check, ...] = (
    root_folder,
    *(versions, native_libraries, optimised, cores, memory, home),
    *(loopback, temporary_folder, shared_memory, descriptors, cluster, films),
)
"""For `t6gps doctor`."""

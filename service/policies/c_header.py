"""Policies as one C99 header, `policy.h` with the numbers filled in. A comment of it holds the description.

To drive the simulator, a header is compiled into a shared library by the C compiler of this machine.
"""

from __future__ import annotations

import ctypes
import hashlib
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterable
from importlib import resources
from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from t6gps.service.policies import tables
from t6gps.service.policies.decision import NEAREST_WAYPOINT_M
from t6gps.service.policies.description import Description, read
from t6gps.service.policies.driver import Array, Measurement, State
from t6gps.storage.errors import ConfigError, DataError
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import NODE_SCALE_M, OBSERVATION_N, REST_LENGTH_SCALE_M
from t6gps.workers.robot.observation import ANGULAR_VELOCITY_SCALE_RAD_PER_S, FARTHEST_NODE, SLOWEST_TRACK_M_PER_S
from t6gps.workers.settings import RobotSettings

TEMPLATE = "policy.h"
DESCRIPTION = re.compile(r"^ \* t6gps-policy: (.*)$", re.MULTILINE)
SUM = "/* sha256 of all above: {} */\n"
LINE_N = 8
"""Numbers on a line."""
OPTIONS = ("-std=c99", "-O3", "-shared", "-fPIC")
SOURCE = (
    '#include "{}"\nvoid decide(const t6gps_measurement *m, t6gps_state *s, double *c) {{ t6gps_decide(m, s, c); }}\n'
)


def write(policy: PolicySnapshot, robot: RobotSettings, description: Description, file: Path) -> None:
    """Write a policy as a C header."""
    widths = description.layers
    parameters = np.concatenate([part.ravel() for weight, bias in policy.layers for part in (bias, weight.T)])
    filled = {
        "DESCRIPTION": description.to_json().replace("*/", "*\\/"),
        "RUN": description.run,
        "VERSION": description.policy_version,
        "SCHEMA": description.schema_version,
        "SHA256": description.sha256,
        "PERIOD": description.control_period_s,
        "SHORTEST": robot.shortest_command_m,
        "LONGEST": robot.longest_command_m,
        "OFFSET": policy.offset_m,
        "OFFSET_FLOAT": _single(policy.offset_m),
        "SCALE_FLOAT": _single(policy.scale_m),
        "REST_SCALE": REST_LENGTH_SCALE_M,
        "ANGULAR_SCALE": ANGULAR_VELOCITY_SCALE_RAD_PER_S,
        "SLOWEST": SLOWEST_TRACK_M_PER_S,
        "NEAREST": NEAREST_WAYPOINT_M,
        "NODE_SCALE": NODE_SCALE_M,
        "FARTHEST": FARTHEST_NODE,
        "SEEN": widths[0],
        "WIDEST": max(OBSERVATION_N, *widths),
        "LAYERS": len(policy.layers),
        "WIDTHS": _braces(widths),
        "PARAMETERS_N": len(parameters),
        "PARAMETERS": _lines([_single(value) for value in parameters]),
        "CABLES": _array(np.array(description.cables)),
        **{name.upper(): _array(values) for name, values in tables.INTS.items()},
        **{name.upper(): _array(values) for name, values in tables.FLOATS.items()},
    }
    template = resources.files(__package__).joinpath(TEMPLATE).read_text(encoding="utf-8")
    text = re.sub(r"@(\w+)@", lambda place: str(filled[place[1]]), template)
    file.write_text(text + SUM.format(digest(text)), encoding="utf-8")


def _single(value: float | np.float32) -> str:
    """A float of C that reads back as the same 32 bits."""
    return f"{np.format_float_scientific(np.float32(value))}f"


def _array(values: NDArray[np.int64] | NDArray[np.float64]) -> str:
    """An initialiser of an array."""
    return _braces(values.tolist() if values.ndim == 1 else [_array(row) for row in values])


def _braces(values: Iterable[object]) -> str:
    return "{" + ", ".join(map(str, values)) + "}"


def _lines(values: list[str]) -> str:
    rows = (", ".join(values[first : first + LINE_N]) for first in range(0, len(values), LINE_N))
    return "{\n    " + ",\n    ".join(rows) + "}"


def digest(text: str) -> str:
    """SHA-256 of a header without its last line."""
    return hashlib.sha256(text.encode()).hexdigest()


@final
class CDriver:
    """A policy in a C header, compiled by this machine's compiler.

    DataError where it is none, or is not as it was written; ConfigError without a compiler.
    """

    def __init__(self, file: Path) -> None:
        text = file.read_text(encoding="utf-8", errors="replace")
        described = DESCRIPTION.search(text)
        if described is None:
            raise DataError(f"{file} is no header of a policy; export one: t6gps policy export RUN --format c")
        body, mark, _ = text.rpartition(SUM.partition("{")[0])
        if not mark or text != body + SUM.format(digest(body)):
            raise DataError(f"{file} is truncated or altered: it fails its SHA-256; export the policy again")
        self.description = read(described[1], file)
        self._decide = compiled(file, SOURCE, "decide")

    def decide(self, measured: Measurement, state: State) -> tuple[Array, State]:
        """As `driver.Driver`."""
        values = np.concatenate([np.asarray(part, dtype=np.float64).ravel() for part in vars(measured).values()])
        after, commands = state.astype(np.intc), np.empty(24)
        self._decide(*(array.ctypes.data_as(ctypes.c_void_p) for array in (values, after, commands)))
        return commands, after.astype(np.int64)


def compiled(file: Path, source: str, name: str) -> Callable[..., None]:
    """A function of a source that includes a header as `{}`, by the compiler cc or gcc; a pointer is a c_void_p."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise ConfigError(
            f"{file} needs a C compiler, found neither cc nor gcc; install one, or export with --format onnx"
        )
    with tempfile.TemporaryDirectory(prefix="t6gps-") as folder:
        text, library = Path(folder, "policy.c"), Path(folder, "policy.so")
        shutil.copyfile(file, Path(folder, "policy.h"))  # a name that every compiler reads
        text.write_text(source.format("policy.h"))
        done = subprocess.run(
            [compiler, *OPTIONS, str(text), "-o", str(library), "-lm"], capture_output=True, text=True, check=False
        )
        if done.returncode:
            raise DataError(f"{file} does not compile: {done.stderr.strip()[:500]}; export the policy again")
        function: Callable[..., None] = getattr(ctypes.CDLL(str(library)), name)
    return function

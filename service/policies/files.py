"""Files of policies: written whole or not at all, and opened by what their suffix says."""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Protocol, cast

from t6gps.service.config import Config
from t6gps.service.policies.description import Description, describe
from t6gps.service.policies.driver import Driver
from t6gps.service.training.origin import Origin
from t6gps.storage import durable
from t6gps.storage.errors import ConfigError
from t6gps.storage.records import PolicySnapshot
from t6gps.storage.schema import OBSERVATION_N, SENSORS_N
from t6gps.workers.episode import policy as acting
from t6gps.workers.robot.topology import CABLES_N
from t6gps.workers.settings import RobotSettings


class Format(StrEnum):
    """Formats that a policy leaves in."""

    ONNX = "onnx"
    TORCHSCRIPT = "torchscript"
    C = "c"


class _Write(Protocol):
    def __call__(self, policy: PolicySnapshot, robot: RobotSettings, description: Description, file: Path) -> None: ...


class _Open(Protocol):
    def __call__(self, file: Path) -> Driver: ...


@dataclass(frozen=True)
class _Form:
    suffix: str
    module: str
    driver: str


FORMS = {
    Format.ONNX: _Form(".onnx", "t6gps.service.policies.onnx", "OnnxDriver"),
    Format.TORCHSCRIPT: _Form(".pt", "t6gps.service.policies.torchscript", "TorchScriptDriver"),
    Format.C: _Form(".h", "t6gps.service.policies.c_header", "CDriver"),
}
"""Suffix of each format, its module, and the driver in that. Modules wait until somebody wants their libraries."""


def write(
    form: Format, out: Path | None, run: str, config: Config, origin: Origin | None, policy: PolicySnapshot
) -> Path:
    """Write a policy of a run, by default to RUN-VERSION with the format's suffix; the file.

    ConfigError for a file that exists or cannot be written, another suffix than the format's, or a library that is not
    installed; DataError for a policy that does not fit the robot.
    """
    acting.check(policy, (SENSORS_N, OBSERVATION_N), CABLES_N)
    suffix = FORMS[form].suffix
    file = Path(f"{run}-{policy.version}{suffix}") if out is None else out
    if file.suffix != suffix:
        raise ConfigError(f"a policy as {form} is a file that ends in {suffix}, found {file}; choose another name")
    if file.exists():
        raise ConfigError(f"{file} exists already; remove it, or name another file with --out")
    save = cast(_Write, _part(form, "write"))
    try:
        draft = durable.hidden(file)
        save(policy, config.robot, describe(run, config, origin, policy), draft)
        durable.publish(file)
    except (OSError, RuntimeError) as error:
        reason = error.strerror if isinstance(error, OSError) else str(error).splitlines()[0]
        raise ConfigError(f"cannot write {file}: {reason}; name a file in a folder that you may write to") from None
    finally:
        durable.hidden(file).unlink(missing_ok=True)
    return file


def opened(file: Path) -> Driver:
    """The policy in a file. ConfigError for one that cannot be read or has another suffix, DataError for no policy."""
    forms = {kind.suffix: form for form, kind in FORMS.items()}
    if file.suffix not in forms:
        allowed = ", ".join(f"{suffix} ({form})" for suffix, form in forms.items())
        raise ConfigError(f"{file} has no suffix of a policy; allowed: {allowed}; export one with t6gps policy export")
    form = forms[file.suffix]
    try:
        with file.open("rb") as content:
            content.read(1)
    except OSError as error:
        raise ConfigError(f"cannot read the policy {file}: {error.strerror}; give an existing file") from None
    return cast(_Open, _part(form, FORMS[form].driver))(file)


def _part(form: Format, name: str) -> object:
    """A function or class of a format's module. ConfigError where its libraries are not installed."""
    try:
        return getattr(importlib.import_module(FORMS[form].module), name)
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"a policy as {form} needs {error.name}; install it with: pip install 't6gps[export]', or choose another "
            "format"
        ) from None

"""Where a job may run: kinds of targets, and what a file of targets says of each.

A file of targets is TOML with a section for each kind:

    [slurm]
    partition = "cpu"
    nodes = 2
    cpus_per_node = 16
"""

from __future__ import annotations

import json
import sys
import tomllib
from enum import StrEnum
from pathlib import Path

from pydantic import Field, ValidationError

from t6gps.storage.errors import ConfigError
from t6gps.storage.settings import Settings


class Kind(StrEnum):
    """Kinds of targets."""

    LOCAL = "local"
    RAY = "ray"
    SLURM = "slurm"
    K8S = "k8s"


class Local(Settings):
    """This machine: the job runs in the background. There is nothing to choose."""


class Slurm(Settings):
    """An allocation of a Slurm cluster. What is not given is the cluster's default."""

    partition: str | None = Field(None, pattern=r"^\S+$", description="partition")
    account: str | None = Field(None, pattern=r"^\S+$", description="account that is charged")
    qos: str | None = Field(None, pattern=r"^\S+$", description="quality of service")
    nodes: int = Field(1, ge=1, le=10000, description="nodes of a run")
    cpus_per_node: int = Field(2, ge=1, le=1024, description="CPUs of each node")
    memory_mb_per_node: int | None = Field(None, ge=1, description="memory of each node (MB)")
    minutes: int | None = Field(None, ge=2, description="time limit (min); the run stops cleanly a minute before")
    bin: str = Field(
        str(Path(sys.executable).parent), pattern=r"^/", description="folder of the programs t6gps and ray on nodes"
    )


class Ray(Settings):
    """A cluster of Ray that is up, by its Jobs API. Its token comes from the environment, as for Ray itself."""

    address: str = Field("http://127.0.0.1:8265", pattern=r"^https?://[^/\s]+$", description="http://HEAD:8265")
    root: str | None = Field(
        None, pattern=r"^/", description="folder of the runs on the cluster, where this machine does not see it"
    )
    bin: str | None = Field(None, pattern=r"^/", description="folder of the programs t6gps and python on the nodes")


Target = Local | Ray | Slurm
TARGETS: dict[Kind, type[Local] | type[Ray] | type[Slurm]] = {Kind.LOCAL: Local, Kind.RAY: Ray, Kind.SLURM: Slurm}
"""What is known of each kind; a kind that is not here cannot be launched on yet."""


def read(kind: Kind, file: Path | None) -> Target:
    """The target of a kind that a file describes, or its defaults without one. ConfigError for what is not allowed."""
    if kind not in TARGETS:
        raise ConfigError(f"--to {kind}: not supported by this version; allowed: {', '.join(TARGETS)}")
    return parse(kind, {} if file is None else _section(kind, file), str(file))


def parse(kind: Kind, values: object, where: str) -> Target:
    """The target that a section's values make. ConfigError that names `where` for what is not allowed."""
    known = TARGETS[kind]
    try:
        return known.model_validate_json(json.dumps(values))
    except TypeError as error:
        raise ConfigError(f"{where}: [{kind}]: {error}; use numbers, strings and booleans") from None
    except ValidationError as error:
        faults = [
            f"{'.'.join([kind.value, *map(str, item['loc'])])}: {item['msg']}, found {item['input']!r}"
            for item in error.errors()
        ]
        allowed = ", ".join(f"{name} ({field.description})" for name, field in known.model_fields.items())
        raise ConfigError(f"{where}: {'; '.join(faults)}; allowed: {allowed or 'no settings'}") from None


def _section(kind: Kind, file: Path) -> object:
    """The section of a kind in a file of targets."""
    try:
        values = tomllib.loads(file.read_bytes().decode("utf-8-sig"))
    except OSError as error:
        raise ConfigError(f"cannot read the targets {file}: {error.strerror}; give an existing file") from None
    except ValueError as error:  # of TOML, or of UTF-8
        raise ConfigError(f"{file} is not TOML in UTF-8: {error}; correct the file") from None
    unknown = sorted(values.keys() - set(Kind))
    if unknown:
        raise ConfigError(f"{file}: unknown section [{unknown[0]}]; allowed: {', '.join(f'[{kind}]' for kind in Kind)}")
    if kind not in values:
        raise ConfigError(f"{file} has no section [{kind}]; add one, or choose another target with --to")
    return values[kind]

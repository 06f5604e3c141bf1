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
from typing import Literal

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


DNS_LABEL = r"^[a-z0-9]([-a-z0-9]{0,61}[a-z0-9])?$"
DNS_NAME = r"^[a-z0-9]([-.a-z0-9]{0,251}[a-z0-9])?$"


class K8s(Settings):
    """A namespace of a Kubernetes cluster with KubeRay, and a claim there that holds the root of runs."""

    image: str = Field(pattern=r"^\S+$", description="image with t6gps, its user has the number 1000")
    claim: str = Field(pattern=DNS_NAME, description="PersistentVolumeClaim, ReadWriteMany, that holds the runs")
    context: str | None = Field(None, min_length=1, description="context of kubectl; without it the current one")
    namespace: str = Field("default", pattern=DNS_LABEL, description="namespace")
    service_account: str | None = Field(None, pattern=DNS_NAME, description="service account of the pods")
    image_pull_policy: Literal["Always", "IfNotPresent", "Never"] | None = Field(
        None, description="Always, IfNotPresent or Never"
    )
    head_cpus: int = Field(2, ge=1, le=1024, description="CPUs of the head, which learns and runs no workers")
    head_memory_gb: int = Field(8, ge=2, le=4096, description="memory of the head (GiB)")
    cpus_per_pod: int = Field(4, ge=1, le=1024, description="CPUs of each pod with workers")
    memory_gb_per_pod: int = Field(8, ge=2, le=4096, description="memory of each pod with workers (GiB)")
    pods: int = Field(8, ge=1, le=1000, description="most pods with workers of a run")
    store_secret: str | None = Field(
        None, pattern=DNS_NAME, description="Secret with the variables AWS_... of the object store, for --publish"
    )
    store_port: int = Field(443, ge=1, le=65535, description="port of the object store, for --publish")
    retries: int = Field(3, ge=0, le=100, description="times that a job is started anew whose head was lost")


Target = Local | Ray | Slurm | K8s
TARGETS: dict[Kind, type[Local] | type[Ray] | type[Slurm] | type[K8s]] = {
    Kind.LOCAL: Local,
    Kind.RAY: Ray,
    Kind.SLURM: Slurm,
    Kind.K8S: K8s,
}
"""What is known of each kind."""


def read(kind: Kind, file: Path | None) -> Target:
    """The target of a kind that a file describes, or its defaults without one. ConfigError for what is not allowed."""
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

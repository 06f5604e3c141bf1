"""Where a figure or a file comes from: the commit, the date, the machine and the versions of the libraries."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata, util
from pathlib import Path

from t6gps.service import threads
from t6gps.storage.schema import SCHEMA_VERSION

SHORT_N = 12
"""Digits of a digest that tell two apart in a message."""

PACKAGES = ("t6gps", "pybullet", "numpy", "pyarrow", "torch", "ray")
"""Those on which the data of a run depend."""

COMPILED = (
    "workers.physics.bullet_hooks._overrides",
    "workers.physics.bullet_hooks._stepper",
    "workers.physics._observer",
    "workers.episode._policy",
    "learner._backward",
)
"""The package's own compiled modules, on which they depend as well."""


@dataclass(frozen=True)
class Provenance:
    """What made a measurement, and when: the date is UTC in ISO 8601.

    processor   its name, and the bits of its widest vectors
    blas        the processor that NumPy's BLAS computes for; another one rounds otherwise (docs/results.md)
    """

    commit: str
    date: str
    platform: str
    processor: str
    blas: str
    cores: int
    versions: dict[str, str]


def provenance() -> Provenance:
    """Of what this process makes now."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    cores = os.cpu_count() or 1
    return Provenance(commit(), now, platform.platform(), processor(), threads.blas(), cores, versions())


def processor() -> str:
    """The processor's name, and the bits of its widest vectors where it is one that has AVX."""
    about = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    name, flags = (re.search(rf"^{key}\s*: (.*)$", about, re.MULTILINE) for key in ("model name", "flags"))
    known = flags[1].split() if flags else []
    bits = next((bits for flag, bits in (("avx512f", 512), ("avx2", 256)) if flag in known), None)
    title = name[1] if name else platform.machine()
    return f"{title}, {bits} bits" if bits else title


def commit(module: Path = Path(__file__)) -> str:
    """The checked-out commit that a module of ours is tracked in.

    The version of the package where it is installed: without git, or inside of somebody else's repository.
    """
    git = ["git", "-C", str(module.parent)]
    try:
        subprocess.run([*git, "ls-files", "--error-unmatch", module.name], capture_output=True, check=True)
        described = [*git, "describe", "--always", "--dirty", "--exclude", "*"]
        return subprocess.run(described, capture_output=True, text=True, check=True).stdout.strip()
    except (FileNotFoundError, subprocess.CalledProcessError):
        return metadata.version("t6gps")


def versions() -> dict[str, str]:
    """Versions of PACKAGES and of Python, by name."""
    return {name: metadata.version(name) for name in PACKAGES} | {"python": platform.python_version()}


def compiled() -> dict[str, str]:
    """SHA-256 of those of COMPILED that are built, by name."""
    specs = {name: util.find_spec(f"t6gps.{name}") for name in COMPILED}
    return {name: sha256(Path(spec.origin).read_bytes()) for name, spec in specs.items() if spec and spec.origin}


def build() -> dict[str, str]:
    """What data depend on in this installation, beside the settings: versions, digests and the schema, by names."""
    digests = {f"compiled {name}": digest[:SHORT_N] for name, digest in compiled().items()}
    return {**versions(), "schema": str(SCHEMA_VERSION), **digests}


def differences(found: Mapping[str, str], here: Mapping[str, str], whose: str = "the run") -> str:
    """In what one `build` is another than that of `whose`, with both values; empty where they are alike."""
    return ", ".join(
        f"{name} {found.get(name, 'none')} ({whose}: {here.get(name, 'none')})"
        for name in {**here, **found}
        if found.get(name) != here.get(name)
    )


def sha256(content: bytes) -> str:
    """Its SHA-256 in hexadecimal digits."""
    return hashlib.sha256(content).hexdigest()

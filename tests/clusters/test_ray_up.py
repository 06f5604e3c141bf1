"""Laws of the file for `ray up`: Ray itself accepts it, and its commands say what the documentation says."""

from __future__ import annotations

import subprocess
from importlib import resources
from pathlib import Path
from typing import Any

import pytest
import yaml
from jsonschema import ValidationError
from ray.autoscaler._private.util import prepare_config, validate_config  # what `ray up` calls; it has no public name

FILE = resources.files("t6gps.deploy") / "ray" / "cluster.yaml"


@pytest.fixture
def described() -> dict[str, Any]:
    return yaml.safe_load(FILE.read_text())


def test_the_file_keeps_to_the_schema_of_ray(described: dict[str, Any]) -> None:
    prepared = prepare_config(described)
    validate_config(prepared)
    (node,) = prepared["available_node_types"].values()
    assert (node["min_workers"], node["max_workers"]) == (0, len(described["provider"]["worker_ips"]))
    with pytest.raises(ValidationError, match="worker_count"):
        validate_config(prepared | {"worker_count": 3})


def test_its_commands_are_shell_and_its_environment_reaches_ray(described: dict[str, Any], tmp_path: Path) -> None:
    kinds = ("setup_commands", "head_start_ray_commands", "worker_start_ray_commands")
    for command in [command for kind in kinds for command in described[kind]]:
        subprocess.run(["bash", "-n", "-c", command], check=True)
    home = {"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "RAY_HEAD_IP": "192.0.2.1"}
    (tmp_path / "t6gps" / "bin").mkdir(parents=True)
    ray = tmp_path / "t6gps" / "bin" / "ray"
    ray.write_text('#!/bin/bash\necho "$RAY_AUTH_MODE $RAY_worker_niceness $*" >> ~/said\n')
    ray.chmod(0o755)
    write_environment = described["setup_commands"][-1]
    for command in [write_environment, *described["worker_start_ray_commands"]]:
        subprocess.run(["bash", "-c", command], check=True, env=home)
    assert (tmp_path / "said").read_text().splitlines() == ["token 0 stop", "token 0 start --address=192.0.2.1:6379"]

"""Laws of provenance: it names what made a file, so that the file can be made again."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from importlib import metadata
from pathlib import Path

import pytest

from t6gps.service.provenance import COMPILED, build, commit, differences, provenance, versions
from t6gps.storage.schema import SCHEMA_VERSION


def test_provenance_is_of_this_process_and_of_now() -> None:
    origin = provenance()
    assert origin.commit and origin.cores >= 1
    age = datetime.now(UTC) - datetime.fromisoformat(origin.date)
    assert timedelta(0) <= age < timedelta(minutes=1)
    assert origin.versions == versions()
    assert origin.processor


def test_the_processor_that_blas_computes_for_can_be_chosen() -> None:
    say = "from t6gps.service.provenance import provenance; print(provenance().blas)"
    chosen = {**os.environ, "OPENBLAS_CORETYPE": "Nehalem"}
    said = subprocess.run([sys.executable, "-c", say], env=chosen, capture_output=True, text=True, check=True).stdout
    assert said.strip() == "Nehalem"


def test_versions_name_what_the_data_of_an_episode_depend_on() -> None:
    assert versions()["pybullet"] == metadata.version("pybullet")
    assert versions()["python"] == platform.python_version()


def test_a_build_names_versions_schema_and_each_compiled_module() -> None:
    found = build()
    assert found["t6gps"] == metadata.version("t6gps")
    assert found["schema"] == str(SCHEMA_VERSION)
    assert {f"compiled {name}" for name in COMPILED} <= found.keys()


def test_differences_name_what_is_missing_on_either_side() -> None:
    assert differences(build(), build()) == ""
    assert differences({"a": "1", "b": "2"}, {"b": "3", "c": "4"}) == (
        "b 2 (the run: 3), c none (the run: 4), a 1 (the run: none)"
    )


def test_without_git_the_version_stands_for_the_commit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert commit() == metadata.version("t6gps")


def test_the_commit_of_another_repository_around_the_installation_is_not_ours(tmp_path: Path) -> None:
    module = tmp_path / "installed.py"
    module.touch()
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    subprocess.run([*git, "init", "--quiet"], check=True)
    subprocess.run([*git, "commit", "--quiet", "--allow-empty", "--message=theirs"], check=True)
    assert commit(module) == metadata.version("t6gps")
    subprocess.run([*git, "add", module.name], check=True)
    assert commit(module) != metadata.version("t6gps")

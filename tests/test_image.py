"""Laws of the image that hold before it is built; `make image` builds it and trains in it."""

from __future__ import annotations

import json
import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
DOCKERFILE = (REPOSITORY / "deploy" / "Dockerfile").read_text()
BUILD, RUNTIME = re.split(r"^FROM \$\{BASE\}", DOCKERFILE, flags=re.MULTILINE)[1:]
IGNORED = [line for line in (REPOSITORY / ".dockerignore").read_text().splitlines() if not line.startswith("#")]


def sent(path: str) -> bool:
    """Whether a file is sent to the build: of the lines that speak of it or of a folder above it, the last decides."""
    found = True
    names = [path, *(str(folder) for folder in Path(path).parents if folder.name)]
    for line in IGNORED:
        pattern = line.removeprefix("!").removeprefix("**/")
        of = [Path(name).name for name in names] if "**/" in line else names
        if any(fnmatch(name, pattern) for name in of):
            found = line.startswith("!")
    return found


def test_the_image_has_the_python_of_the_project() -> None:
    makefile = (REPOSITORY / "Makefile").read_text()
    (base,) = re.findall(r"^ARG BASE=(\S+)$", DOCKERFILE, re.MULTILINE)
    assert re.findall(r"^BASE \?= (\S+)$", makefile, re.MULTILINE) == [base]
    (python,) = re.findall(r"python(3\.\d+) -m venv", BUILD)
    assert f"python:{python}-" in base
    assert PROJECT["project"]["requires-python"].startswith(f">={python},")


def test_the_image_has_only_extras_that_there_are() -> None:
    (extras,) = re.findall(r"t6gps-\*\.whl\)\[(.+?)\]", BUILD)
    assert set(extras.split(",")) <= set(PROJECT["project"]["optional-dependencies"])


def test_the_compiler_stays_behind() -> None:
    assert "gcc" in BUILD
    assert "gcc" not in RUNTIME


def test_the_image_runs_the_command_as_a_user_without_rights() -> None:
    assert re.findall(r"^USER (.+)$", RUNTIME, re.MULTILINE) == ["1000:1000"]
    (entry,) = re.findall(r"^ENTRYPOINT (.+)$", RUNTIME, re.MULTILINE)
    assert json.loads(entry) == list(PROJECT["project"]["scripts"])


def test_the_build_gets_what_the_wheel_is_made_of() -> None:
    rooms = PROJECT["tool"]["setuptools"]["package-dir"].values()
    sources = [source for module in PROJECT["tool"]["setuptools"]["ext-modules"] for source in module["sources"]]
    modules = [str(path.relative_to(REPOSITORY)) for room in rooms for path in (REPOSITORY / room).rglob("*.py*")]
    needed = [path for path in modules if "__pycache__" not in path] + sources
    needed += ["pyproject.toml", PROJECT["project"]["readme"], *PROJECT["project"]["license-files"]]
    deployed = (path for path in (REPOSITORY / "deploy").glob("*/*.*") if "__pycache__" not in path.parts)
    needed += [str(path.relative_to(REPOSITORY)) for path in deployed]
    assert not [path for path in needed if not sent(path)]


def test_the_build_gets_nothing_of_runs_environments_and_caches() -> None:
    others = [".git/config", ".venv/bin/python", "runs/rough/config.json", "build/lib/t6gps.py", "tests/conftest.py"]
    others += ["service/__pycache__/api.pyc", "learner/_backward.cpython-311-x86_64-linux-gnu.so", "targets.toml"]
    assert not [path for path in others if sent(path)]

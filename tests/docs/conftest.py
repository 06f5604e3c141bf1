"""What the tests of documents share: the renderer of docs, which is no module of the package, and the pages."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="session")
def render() -> ModuleType:
    """docs/render.py as a module."""
    spec = importlib.util.spec_from_file_location("render", REPOSITORY / "docs" / "render.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def pages() -> dict[str, str]:
    """Text of README.md, CONTRIBUTING.md and every page of docs, by its path in the repository."""
    files = [*REPOSITORY.glob("README.md"), *REPOSITORY.glob("CONTRIBUTING.md"), *REPOSITORY.glob("docs/**/*.md")]
    return {str(file.relative_to(REPOSITORY)): file.read_text(encoding="utf-8") for file in files}


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the repository."""
    return REPOSITORY

"""Laws of the documents: what they link to, call, import and name exists, and they are short."""

from __future__ import annotations

import ast
import importlib
import json
import re
import subprocess
import tomllib
from collections.abc import Iterator
from fnmatch import fnmatch
from pathlib import Path

import calls
import pytest

LINK = re.compile(r"\[[^\]]*\]\(([^)\s]+)\)")
FENCE = re.compile(r"^ *```.*?^ *```", re.MULTILINE | re.DOTALL)
INDENTED = re.compile(r"^ {4}.*$", re.MULTILINE)
CONSOLE = re.compile(r"^ *```console\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
CODE = re.compile(r"`([^`]+)`")
COMMIT = re.compile(r"\b(?=[0-9a-f]*\d)[0-9a-f]{7}\b")
MODULE = re.compile(r"[\w./-]+\.py")
TESTS = re.compile(r"([\w./-]+\.py)::(\w+\*?)")
PYTHON = re.compile(r"^ *```python\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
LAB_NOTES = "docs/lab-notes.md"
"""What was measured at which commit belongs to them alone."""


def _slug(heading: str) -> str:
    """The anchor that GitHub gives to a heading."""
    return re.sub(r"[^\w\- ]", "", CODE.sub(r"\1", heading).strip().lower()).replace(" ", "-")


def _anchors(text: str) -> set[str]:
    return {_slug(heading) for heading in re.findall(r"^#+ (.*)$", FENCE.sub("", text), re.MULTILINE)}


def _calls(text: str) -> Iterator[list[str]]:
    """Arguments of every call of `t6gps` in blocks of commands and in code within the prose."""
    for block in CONSOLE.findall(text):
        yield from calls.arguments(block)
    for code in CODE.findall(FENCE.sub("", text)):
        yield from calls.arguments(" ".join(code.split()))


def _sentences(text: str) -> list[str]:
    """The sentences of a page, without tables, captions of tables, code, headings and addresses."""
    text = re.sub(r"<!--.*?-->", "", CODE.sub("code", INDENTED.sub("", FENCE.sub("", text))), flags=re.DOTALL)
    text = re.sub(
        r"^(\||#).*$", "", re.sub(r"^\*code.*?\*$", "", text, flags=re.MULTILINE | re.DOTALL), flags=re.MULTILINE
    )
    text = re.sub(r"!?\[([^\]]*)\]\([^)]*\)", r"\1", text)
    blocks = re.split(r"\n\s*\n|^\s*- ", text, flags=re.MULTILINE)
    return [sentence for block in blocks for sentence in re.split(r"(?<=[.?!])[*\s]+(?=\S)", block) if sentence.strip()]


def _imports(code: str) -> Iterator[tuple[str, str | None]]:
    """Module of every import, and the name that is taken from it."""
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield from ((node.module, alias.name) for alias in node.names)


def _exists(module: str, name: str | None) -> bool:
    try:
        imported = importlib.import_module(module)
        if name is not None and not hasattr(imported, name):
            importlib.import_module(f"{module}.{name}")
    except ImportError:
        return False
    return True


def _functions(file: Path) -> list[str]:
    return [node.name for node in ast.parse(file.read_text()).body if isinstance(node, ast.FunctionDef)]


def _words(sentence: str) -> int:
    return sum(any(letter.isalnum() for letter in word) for word in sentence.split())


def test_every_link_and_picture_leads_somewhere(pages: dict[str, str], repository: Path) -> None:
    broken = []
    for page, text in pages.items():
        for target in LINK.findall(FENCE.sub("", text)):
            if target.startswith(("http://", "https://")):
                continue
            name, _, anchor = target.partition("#")
            file = (repository / page).parent / name if name else repository / page
            if not file.exists() or (anchor and anchor not in _anchors(file.read_text(encoding="utf-8"))):
                broken.append(f"{page}: {target}")
    assert not broken


def test_every_page_and_picture_is_linked(pages: dict[str, str], repository: Path) -> None:
    linked = {
        ((repository / page).parent / target.partition("#")[0]).resolve()
        for page, text in pages.items()
        for target in LINK.findall(text)
    }
    wanted = {repository / page for page in pages} | set((repository / "docs" / "images").iterdir())
    assert {file for file in wanted if file.name not in {"README.md", "CONTRIBUTING.md"}} <= linked


def test_every_command_option_and_setting_on_a_page_exists(pages: dict[str, str]) -> None:
    complaints = [
        f"{page}: {wrong}" for page, text in pages.items() for call in _calls(text) for wrong in calls.complaints(call)
    ]
    assert not complaints


def test_every_command_of_a_measurement_exists(repository: Path) -> None:
    commands = [json.loads(file.read_text())["command"] or "" for file in (repository / "docs" / "figures").iterdir()]
    made = [call for command in commands for call in calls.arguments(command)]
    assert len(made) >= len([command for command in commands if command])
    assert not [wrong for call in made for wrong in calls.complaints(call)]


@pytest.mark.parametrize("call", ["trian flat", "train flat --quick", "eval RUN --set terrain.steepness=1"])
def test_a_call_of_something_unknown_is_seen(call: str) -> None:
    assert calls.complaints(next(calls.arguments(f"t6gps {call}")))


def test_pages_but_the_lab_notes_name_no_commits(pages: dict[str, str]) -> None:
    named = {page: COMMIT.findall(text) for page, text in pages.items() if page != LAB_NOTES}
    assert not {page: commits for page, commits in named.items() if commits}


def test_sentences_are_short(pages: dict[str, str]) -> None:
    sentences = [(page, sentence) for page, text in pages.items() for sentence in _sentences(text)]
    assert not [long for long in sentences if _words(long[1]) > 25]
    for page, text in pages.items():
        lengths = [_words(sentence) for sentence in _sentences(text)]
        assert sum(lengths) / len(lengths) <= 22, page


@pytest.fixture(scope="module")
def modules(repository: Path) -> list[str]:
    """Paths of all modules that git tracks or would track."""
    listed = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.py"]
    return subprocess.run(listed, cwd=repository, capture_output=True, text=True, check=True).stdout.split()


def test_every_module_that_a_page_names_exists(pages: dict[str, str], modules: list[str]) -> None:
    named = {(page, code) for page, text in pages.items() for code in CODE.findall(FENCE.sub("", text))}
    missing = [
        f"{page}: {code}"
        for page, code in sorted(named)
        if MODULE.fullmatch(code) and not any(f"/{module}".endswith(f"/{code}") for module in modules)
    ]
    assert not missing


def test_every_test_that_a_page_names_exists(pages: dict[str, str], repository: Path) -> None:
    named = {(page, *law) for page, text in pages.items() for law in TESTS.findall(text)}
    assert any(page == "docs/reliability.md" for page, *_ in named)
    missing = [
        f"{page}: {file}::{pattern}"
        for page, file, pattern in sorted(named)
        if not any(fnmatch(name, pattern) for name in _functions(repository / file))
    ]
    assert not missing


def test_every_import_in_code_on_a_page_works(pages: dict[str, str]) -> None:
    wanted = {(page, *what) for page, text in pages.items() for code in PYTHON.findall(text) for what in _imports(code)}
    assert not [
        f"{page}: {module} {name or ''}" for page, module, name in sorted(wanted, key=str) if not _exists(module, name)
    ]


def test_the_architecture_names_every_room(pages: dict[str, str], repository: Path) -> None:
    packages = tomllib.loads((repository / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]
    folders = {package.removeprefix("t6gps.").replace(".", "/") for package in packages}
    assert folders <= {code.rstrip("/") for code in CODE.findall(FENCE.sub("", pages["docs/architecture.md"]))}


def test_the_newest_changes_are_those_of_the_version(repository: Path) -> None:
    version = tomllib.loads((repository / "pyproject.toml").read_text())["project"]["version"]
    newest = re.search(
        r"^## \[(.+?)\] - 20\d\d-[01]\d-[0-3]\d$", (repository / "CHANGELOG.md").read_text(), re.MULTILINE
    )
    assert newest is not None
    assert newest[1] == version

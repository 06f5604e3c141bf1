"""Laws of the house: small folders, classes and functions, few untyped values, tests that use what is public."""

from __future__ import annotations

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

REPOSITORY = Path(__file__).parents[1]
ROOMS = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]["package-dir"].values()

MODULES_MOST_N, CLASS_LINES_MOST_N, FUNCTION_LINES_MOST_N = 12, 150, 50
ANY_MOST_N, PRIVATE_MEMBERS_MOST_N, PATCHES_MOST_N = 60, 5, 8


def parsed(folders: Iterator[Path]) -> dict[str, ast.Module]:
    """Syntax trees of all modules below folders, by their paths in the repository."""
    modules = (path for folder in folders for path in sorted(folder.rglob("*.py")))
    return {path.relative_to(REPOSITORY).as_posix(): ast.parse(path.read_text()) for path in modules}


PACKAGE = parsed(REPOSITORY / room for room in ROOMS)
TESTS = parsed(iter([REPOSITORY / "tests"]))


def longer_than(lines_n: int, *kinds: type[ast.AST]) -> set[str]:
    """Names MODULE:NAME of the package's definitions of such kinds that have more lines."""
    return {
        f"{module}:{node.name}"
        for module, tree in PACKAGE.items()
        for node in ast.walk(tree)
        if isinstance(node, kinds) and node.end_lineno - node.lineno + 1 > lines_n
    }


def private_members(tree: ast.Module) -> list[str]:
    """Expressions that reach into another object: `thing._member`."""
    return [
        ast.unparse(node)
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and node.attr.startswith("_")
        and not node.attr.startswith("__")
        and not (isinstance(node.value, ast.Name) and node.value.id in ("self", "cls"))
    ]


def patches(tree: ast.Module) -> list[str]:
    """Calls that replace what a module or class holds: `monkeypatch.setattr`. Parameters and hooks are better."""
    return [
        ast.unparse(node)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "setattr"
    ]


ROOTS = {"learner/streams.py", "service/seeding.py", "workers/episode/streams.py"}
"""Where the branches of random numbers are named, each in an enum."""
OF_ONE_SEED = {"workers/ground/terrain.py", "workers/stub.py"}
"""What draws from a seed that nothing else draws from: hills, and episodes of a worker on paper."""


def makers(tree: ast.Module) -> set[str]:
    """Names of the calls that make random numbers of a seed."""
    called = {node.func.attr for node in ast.walk(tree) if isinstance(node, ast.Call) and hasattr(node.func, "attr")}
    return called & {"SeedSequence", "default_rng", "spawn", "RandomState", "seed", "manual_seed"}


def test_random_numbers_come_from_named_branches_alone() -> None:
    made = {module: makers(tree) for module, tree in PACKAGE.items() if "/bench/" not in module}
    drawing = {module for module, calls in made.items() if calls}
    assert drawing == ROOTS | OF_ONE_SEED


def test_no_folder_is_crowded() -> None:
    folders: dict[str, int] = {}
    for module in PACKAGE:
        folder, _, name = module.rpartition("/")
        folders[folder] = folders.get(folder, 0) + (name != "__init__.py")
    assert not {folder for folder, modules in folders.items() if modules > MODULES_MOST_N}


def test_no_class_is_long() -> None:
    assert not longer_than(CLASS_LINES_MOST_N, ast.ClassDef)


def test_no_function_is_long() -> None:
    assert not longer_than(FUNCTION_LINES_MOST_N, ast.FunctionDef, ast.AsyncFunctionDef)


def test_few_values_are_untyped() -> None:
    counts = {
        module: sum(isinstance(node, ast.Name) and node.id == "Any" for node in ast.walk(tree))
        for module, tree in PACKAGE.items()
    }
    assert sum(counts.values()) <= ANY_MOST_N, {module: count for module, count in counts.items() if count}


def test_tests_reach_into_few_objects() -> None:
    reached = {module: private_members(tree) for module, tree in TESTS.items()}
    assert sum(map(len, reached.values())) <= PRIVATE_MEMBERS_MOST_N, {
        m: names for m, names in reached.items() if names
    }


def test_tests_patch_little() -> None:
    patched = {module: patches(tree) for module, tree in TESTS.items()}
    assert sum(map(len, patched.values())) <= PATCHES_MOST_N, {m: calls for m, calls in patched.items() if calls}

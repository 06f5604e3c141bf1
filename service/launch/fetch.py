"""Bringing a run home: its files are copied, each is verified by SHA-256, and the run appears whole or not at all.

A copy that was cut off is continued: what has come already stays in ROOT/.fetched/RUN and is verified again.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError

FETCHED = ".fetched"
PIECE_BYTES = 1 << 20
ATTEMPTS_N = 3


@dataclass(frozen=True)
class File:
    """A file of a run: its size, and the SHA-256 of its content."""

    size: int
    sha256: str


class Source(Protocol):
    """Where a run's files come from."""

    def files(self) -> dict[str, File]:
        """The run's files by their paths in the run. RunError where somebody trains the run."""
        ...

    def pieces(self, path: str, offset: int) -> Iterator[bytes]:
        """The content of a file from a byte on."""
        ...


class FolderSource:
    """A run in a folder that this machine sees."""

    def __init__(self, run: Run) -> None:
        self.run = run

    def files(self) -> dict[str, File]:
        process = catalog.process_of(self.run)
        if process is not None:
            raise RunError(f"run {self.run.name} is in use by process {process}; stop it, or wait for it to end")
        paths = (path for path in sorted(self.run.path.rglob("*")) if path.is_file())
        names = {path.relative_to(self.run.path): path for path in paths}
        return {str(name): described(path) for name, path in names.items() if not name.parts[0].startswith(".")}

    def essentials(self) -> dict[str, File]:
        """Those that say in which world a policy acts: configuration, origin and ground; also of a run at work."""
        run = self.run
        ground = sorted(run.ground.iterdir()) if run.ground.is_dir() else []
        paths = [path for path in (run.config_path, run.path / "origin.json", *ground) if path.is_file()]
        return {str(path.relative_to(run.path)): described(path) for path in paths}

    def pieces(self, path: str, offset: int) -> Iterator[bytes]:
        with (self.run.path / path).open("rb") as file:
            file.seek(offset)
            while piece := file.read(PIECE_BYTES):
                yield piece


def described(path: Path) -> File:
    """A file as it lies here."""
    return File(path.stat().st_size, durable.sha256(path))


def fetch(source: Source, root: Path, name: str, progress: Callable[[int, int], None]) -> Run:
    """Copy a run to `root` under a name; `progress` is told the files that are done, and all.

    RunError where the name is taken, the root cannot be written, or the run changes meanwhile.
    """
    root = catalog.whole(root)
    path, draft = root / catalog.check_name(name), root / FETCHED / name
    if path.exists():
        raise RunError(f"{path} exists already; choose another name with --run")
    files = source.files()
    try:
        draft.mkdir(parents=True, exist_ok=True)
        _remove_others(draft, files)
        for done, (file, expected) in enumerate(files.items()):
            progress(done, len(files))
            bring(source, draft, file, expected)
        progress(len(files), len(files))
        if source.files() != files:
            raise RunError(f"run {name} has changed while it was fetched; fetch it again when nobody uses it")
        for folder in ("tables", "spool", "checkpoints", "figures"):
            (draft / folder).mkdir(exist_ok=True)
        (draft / ".lock").touch()
        durable.sync_tree(draft)
        if not durable.claim(draft, path):
            raise RunError(f"{path} exists already; choose another name with --run")
        if not any(draft.parent.iterdir()):
            draft.parent.rmdir()
    except OSError as error:
        raise RunError(f"cannot fetch run {name} to {root}: {error}; make room, then fetch it again") from error
    return Run(path)


def bring(source: Source, folder: Path, file: str, expected: File) -> None:
    """Have a file in a folder that is verified; continue one that was cut off. RunError where it comes altered."""
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    for _ in range(ATTEMPTS_N):
        there = path.stat().st_size if path.exists() else 0
        with path.open("ab") as copy:
            if there < expected.size:
                copy.writelines(source.pieces(file, there))
        if described(path) == expected:
            return
        path.unlink()  # its beginning is of another file, or it came altered
    raise RunError(f"{file} came altered {ATTEMPTS_N} times; see whether the run is in use, then fetch it again")


def _remove_others(draft: Path, files: dict[str, File]) -> None:
    """Remove what an earlier copy has brought and the run no longer has."""
    for path in sorted(draft.rglob("*"), reverse=True):
        if path.is_file() and str(path.relative_to(draft)) not in files:
            path.unlink()
        elif path.is_dir() and not any(path.iterdir()):
            shutil.rmtree(path)

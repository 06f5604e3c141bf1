"""A job's folder in the root, ROOT/.jobs/RUN: all that the job needs, so that it depends on nothing of who submits.

config.toml   the configuration, resolved
ground/       the file of the ground, where there is one
publish       the root in an object store that gets a copy of the run, where there is one
train.sh      what every job runs; a script of Slurm uses it
log           everything that the job writes
exit_code     how it ended, written by train.sh
"""

from __future__ import annotations

import itertools
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from t6gps.service import config as configuration
from t6gps.service.config import Config
from t6gps.storage import catalog, durable
from t6gps.storage.errors import RunError, TerrainError
from t6gps.workers.ground.ground import ground

FOLDERS, PUBLISH = ".jobs", "publish"


@dataclass(frozen=True)
class Folder:
    """The folder of a job; a folder of ROOT/.jobs has its run's name."""

    path: Path

    @property
    def run(self) -> str:
        return self.path.name

    @property
    def root(self) -> Path:
        return self.path.parent.parent

    @property
    def config(self) -> Path:
        return self.path / "config.toml"

    @property
    def log(self) -> Path:
        return self.path / "log"

    @property
    def script(self) -> Path:
        return self.path / "train.sh"

    @property
    def publish(self) -> str | None:
        """The root in an object store that gets a copy of the run, s3://BUCKET/PREFIX; None for none."""
        try:
            return (self.path / PUBLISH).read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            return None

    @property
    def exit_code(self) -> int | None:
        """How the job ended, None where it has not said so."""
        try:
            return int((self.path / "exit_code").read_text())
        except (FileNotFoundError, ValueError):
            return None

    def end(self, exit_code: int) -> None:
        """Say how a job ended that cannot say it itself."""
        (self.path / "exit_code").write_text(f"{exit_code}\n")


@dataclass(frozen=True)
class Planned:
    """A job to be: what it trains, its folder, which is not there yet, and where its run is published."""

    config: Config
    folder: Folder
    publish: str | None = None


def of(root: Path, run: str) -> Folder:
    """The folder of the job that trains a run, whether it is there or not."""
    return Folder(catalog.whole(root) / FOLDERS / catalog.check_name(run))


def first_free(root: Path, name: str) -> str:
    """The first of NAME, NAME-2, NAME-3, ... that is neither a run nor a job."""
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(free for free in names if not taken(of(root, free)))


def taken(folder: Folder) -> Path | None:
    """What stands in the way of a new job: the run or the job of that name."""
    return next((path for path in (folder.root / folder.run, folder.path) if os.path.lexists(path)), None)


def check_ground(config: Config) -> None:
    """TerrainError for a file that is no ground, before anything is started with it."""
    if config.terrain.file is not None:
        ground(config.terrain, 0, config.terrain.difficulty)


@contextmanager
def prepared(planned: Planned) -> Iterator[None]:
    """The job's folder, written for a job that is submitted meanwhile; it is as it was where that fails.

    RunError where the root cannot be written, or another job takes the name at this moment.
    """
    folder = planned.folder
    before = folder.path.with_name(f".{folder.run}.before")
    try:
        folder.path.parent.mkdir(parents=True, exist_ok=True)
        with durable.draft(folder.path) as draft:
            write(planned, draft)
            durable.sync_tree(draft)
            if before.exists():  # of a submission that was cut off
                durable.discard(before)
            if folder.path.exists():
                _keep_log(folder.path, draft)
                folder.path.replace(before)
            if not durable.claim(draft, folder.path):
                raise RunError(f"{folder.path} was taken just now; choose another name with --run")
    except OSError as error:
        raise RunError(
            f"cannot prepare a job under {folder.root}: {error}; the root must be a writable folder with room"
        ) from error
    try:
        yield
    except BaseException:
        durable.discard(folder.path)
        if before.exists():
            before.replace(folder.path)
        raise
    shutil.rmtree(before, ignore_errors=True)


def write(planned: Planned, draft: Path) -> None:
    """Write what a job's folder shall hold into an empty folder `draft`. TerrainError for ground that is missing."""
    config, file = planned.config, planned.config.terrain.file
    if file is not None:
        copy = planned.folder.path / "ground" / Path(file).name
        (draft / "ground").mkdir()
        try:
            shutil.copyfile(file, draft / "ground" / copy.name)
        except OSError as error:
            raise TerrainError(f"cannot read ground from {file}: {error.strerror}; correct terrain.file") from error
        config = configuration.with_ground(config, copy)
    (draft / "config.toml").write_text(config.to_toml(), encoding="utf-8")
    if planned.publish is not None:
        (draft / PUBLISH).write_text(f"{planned.publish}\n", encoding="utf-8")
    script = resources.files("t6gps.deploy") / "launch" / "train.sh"
    (draft / "train.sh").write_bytes(script.read_bytes())


def _keep_log(old: Path, draft: Path) -> None:
    if (old / "log").exists():
        shutil.copyfile(old / "log", draft / "log")

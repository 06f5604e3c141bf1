"""What a run comes from: what made it, and the file of its ground, of which it keeps a copy.

RUN/origin.json is written when a run is created. It says versions, commit and time, and the SHA-256 of the ground.
RUN/ground/FILE is that ground. The run works with this copy, whatever becomes of the file that terrain.file names.
Runs of earlier versions have neither: their ground is the file itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError, field_validator

from t6gps.service import config as configuration
from t6gps.service import provenance
from t6gps.service.config import Config
from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, TerrainError
from t6gps.storage.objects import place
from t6gps.storage.schema import SCHEMA_VERSION
from t6gps.workers.ground.ground import ground
from t6gps.workers.settings import TerrainSettings

FILE = "origin.json"


class Ground(BaseModel):
    """A run's copy of its ground: its path in the run, and its SHA-256."""

    model_config = ConfigDict(frozen=True)

    file: str
    sha256: str


class Origin(BaseModel):
    """What made a run: the date is UTC in ISO 8601, `compiled` has the SHA-256 of the package's compiled modules.

    `processor` and `blas` are those of `Provenance`; earlier versions did not write them.
    """

    model_config = ConfigDict(frozen=True)

    schema_version: int
    commit: str
    date: str
    versions: dict[str, str]
    compiled: dict[str, str]
    processor: str | None = None
    blas: str | None = None
    ground: Ground | None = None

    @field_validator("date")
    @classmethod
    def _is_a_date(cls, date: str) -> str:
        datetime.fromisoformat(date)
        return date


def create(config: Config, root: Path, name: str, numbered: bool = False) -> Run:
    """Create a run that owns what it depends on. Errors as `catalog.create`; TerrainError for a file of no ground."""
    path, files, copy = config.terrain.file, dict[str, bytes](), None
    if path is not None:
        content = _ground(config.terrain, place.at(path))
        copy = Ground(file=f"ground/{Path(path).name}", sha256=provenance.sha256(content))
        files[copy.file] = content
    files[FILE] = (_present(copy).model_dump_json(indent=2, exclude_none=True) + "\n").encode()
    return catalog.create(root, name, config.to_json(), files, numbered)


def _present(copy: Ground | None) -> Origin:
    """The origin of what is created now."""
    now = provenance.provenance()
    return Origin(
        schema_version=SCHEMA_VERSION,
        commit=now.commit,
        date=now.date,
        versions=now.versions,
        compiled=provenance.compiled(),
        processor=now.processor,
        blas=now.blas,
        ground=copy,
    )


def _ground(settings: TerrainSettings, file: Path) -> bytes:
    """The content of a file that is read as ground, so that no run is created on another."""
    ground(settings, 0, settings.difficulty)
    try:
        return file.read_bytes()
    except OSError as error:
        raise TerrainError(f"cannot read ground from {file}: {error.strerror}; correct terrain.file") from error


def kept(run: Run) -> Origin | None:
    """The origin that a run keeps, None for one of an earlier version. RunError where it cannot be read."""
    path = run.path / FILE
    if not path.exists():
        return None
    try:
        record = durable.parsed(path.read_bytes())
        if "study" in record:  # earlier versions kept a run's place in its study there
            return None
        return Origin.model_validate(record)
    except (OSError, ValueError, TypeError, ValidationError) as error:
        reason = " ".join(str(error).split())
        raise RunError(f"run {run.name} is not whole: cannot read {path}: {reason}; restore it from a copy") from None


def at_work(config: Config, run: Run) -> Config:
    """The configuration with the run's own copy of its ground. RunError where that is missing or altered."""
    origin = kept(run)
    if origin is None or origin.ground is None:
        return config
    copy = run.path / origin.ground.file
    found = _digest(copy)
    if found != origin.ground.sha256:
        state = "missing" if found is None else f"altered: its SHA-256 is {found[: provenance.SHORT_N]}"
        raise RunError(
            f"run {run.name} is not whole: its ground {copy} is {state}, {FILE} has "
            f"{origin.ground.sha256[: provenance.SHORT_N]}; restore the file from a copy"
        )
    return configuration.with_ground(config, copy)


def configured(run: Run, overrides: Sequence[str] = ()) -> Config:
    """The configuration that a run works with, in the world that `overrides` change. Errors as `at_work`, `parse`."""
    config = at_work(configuration.kept(run), run)
    return configuration.parse(config.to_json(), overrides) if overrides else config


def differences(run: Run, config: Config) -> list[str]:
    """What makes a configuration another one than the run's; ground counts by its content, wherever its file lies."""
    stored, origin, file = configuration.kept(run), kept(run), config.terrain.file
    if origin is None or origin.ground is None or file is None or stored.terrain.file is None:
        return configuration.differences(stored, config)
    others = configuration.differences(stored, configuration.with_ground(config, Path(stored.terrain.file)))
    found = _digest(Path(file))
    if found == origin.ground.sha256 or (found is None and file == stored.terrain.file):
        return others
    content = "cannot be read" if found is None else f"holds other ground, SHA-256 {found[: provenance.SHORT_N]}"
    return [
        *others,
        f"terrain.file = {file} {content} (the run has {stored.terrain.file}, SHA-256 "
        f"{origin.ground.sha256[: provenance.SHORT_N]}, and keeps it as {run.path / origin.ground.file})",
    ]


def changes(run: Run) -> str | None:
    """A warning that names what made the run and is another now, with both; None where there is nothing.

    RunError for a run of a later version of the tables, which this version would misread.
    """
    origin = kept(run)
    if origin is None:
        return None
    if origin.schema_version > SCHEMA_VERSION:
        raise RunError(
            f"run {run.name} has tables of version {origin.schema_version}, made by t6gps "
            f"{origin.versions.get('t6gps', 'unknown')}; this version reads up to {SCHEMA_VERSION}; install that t6gps"
        )
    then, now = (_named(made) for made in (origin, _present(None)))
    names = [name for name in {**then, **now} if then.get(name) != now.get(name)]
    changed = [f"{name} {then.get(name)} (now {now.get(name)})" for name in names]
    if not changed:
        return None
    return f"run {run.name} was made with {', '.join(changed)}; what is sampled now may differ from its data"


def _named(origin: Origin) -> dict[str, str]:
    """Everything that data may depend on, by names for people."""
    compiled = {f"compiled {name}": digest[: provenance.SHORT_N] for name, digest in origin.compiled.items()}
    return {**origin.versions, "commit": origin.commit, **compiled}


def _digest(file: Path) -> str | None:
    """The SHA-256 of a file, None when it cannot be read."""
    try:
        return provenance.sha256(file.read_bytes())
    except OSError:
        return None

"""The configuration of a run: a preset or a TOML file, overrides, and what to say when something is wrong."""

from __future__ import annotations

import copy
import difflib
import json
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import BaseModel, Field, JsonValue, ValidationError, model_validator

from t6gps.learner.settings import LearnerSettings, Localization
from t6gps.storage import durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError
from t6gps.storage.objects import place
from t6gps.storage.settings import Settings
from t6gps.workers.settings import RolloutSettings

if TYPE_CHECKING:
    from pydantic.fields import FieldInfo
    from pydantic_core import ErrorDetails

WORKERS_MOST_N = 10000


class RunSettings(Settings):
    """Size of a run: N episodes of T control steps in each of I iterations (paper Sec. IV-A)."""

    seed: int = Field(0, ge=0, lt=2**63, description="root of every random stream of the run")
    iterations: int = Field(5, ge=1, le=10000, description="iterations I")
    episodes: int = Field(300, ge=1, le=1000000, description="episodes of an iteration, N")
    steps: int = Field(250, ge=2, le=100000, description="control steps of an episode, T (10 per second)")
    workers: int = Field(2, ge=1, le=WORKERS_MOST_N, description="rollout workers; changes the speed, never the data")
    workers_min: int = Field(1, ge=1, le=WORKERS_MOST_N, description="autoscaling: fewest workers")
    workers_max: int = Field(0, ge=0, le=WORKERS_MOST_N, description="autoscaling: most workers; 0 keeps `workers`")
    cpus_per_worker: float = Field(1.0, gt=0.0, le=64.0, description="CPUs that a worker claims; 0.5 puts two on one")
    pipelined: bool = Field(False, description="sample while the learner works, with a policy one version older")
    evaluation_episodes: int = Field(40, ge=2, le=100000, description="noise-free episodes after the last iteration")

    @model_validator(mode="after")
    def _ordered_workers(self) -> RunSettings:
        if 0 < self.workers_max < self.workers_min:
            raise ValueError("workers_min must not exceed workers_max")
        return self

    @property
    def autoscale(self) -> tuple[int, int] | None:
        """Fewest and most workers, None when their number is fixed."""
        return (self.workers_min, self.workers_max) if self.workers_max else None


NO_EFFECT = {"run.workers", "run.workers_min", "run.workers_max", "run.cpus_per_worker", "terrain.accept"}
"""Keys that data do not depend on."""


class Config(RolloutSettings):
    """Everything that a run's data depends on (and the number of workers)."""

    run: RunSettings = RunSettings()
    learner: LearnerSettings = LearnerSettings()

    @property
    def rollout(self) -> RolloutSettings:
        """The part that the workers need."""
        return RolloutSettings(**{name: getattr(self, name) for name in RolloutSettings.model_fields})

    def to_json(self) -> str:
        """The configuration as the run keeps it; options that are none do not stand in it."""
        return self.model_dump_json(indent=2, exclude_none=True) + "\n"

    def to_toml(self) -> str:
        """The configuration as a file that `load` takes: a line for each key, whose values TOML writes as JSON does."""
        values = _flat(self.model_dump(mode="json", exclude_none=True))
        return "".join(f"{key} = {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())


def presets() -> list[str]:
    """Names of the presets that ship with the package."""
    folder = resources.files("t6gps.deploy") / "presets"
    return sorted(Path(item.name).stem for item in folder.iterdir() if item.name.endswith(".toml"))


def load(source: str, overrides: Sequence[str] = ()) -> Config:
    """Configuration from a preset's name or a TOML file, with overrides `key=value` (dotted key, TOML value or none).

    ConfigError if the source is unknown or not TOML, or a key or value is not allowed.
    """
    if source in presets():
        text = (resources.files("t6gps.deploy") / "presets" / f"{source}.toml").read_text(encoding="utf-8")
    elif source.endswith(".toml"):
        text = _text(Path(source), "the configuration file", "give an existing file")
    else:
        raise ConfigError(
            f"unknown preset '{source}'{_nearest(source, presets())}; "
            f"allowed: {', '.join(presets())}, or the path of a file that ends in .toml"
        )
    return from_toml(text, overrides, source)


def from_toml(text: str, overrides: Sequence[str], where: str) -> Config:
    """The configuration that the text of a file makes, with overrides. ConfigError as for `load`."""
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{where} is not TOML: {error}; correct the file") from None
    return _checked_learner(_with_whole_paths(_validated(_overridden(values, overrides), where)), where)


def kept(run: Run, overrides: Sequence[str] = ()) -> Config:
    """The configuration that a run was created with, with overrides. ConfigError as for `load`."""
    remedy = "restore the file from a copy"
    return parse(
        _text(run.config_path, f"the configuration of run {run.name},", remedy), overrides, str(run.config_path)
    )


def _text(path: Path, what: str, remedy: str) -> str:
    """What a file of UTF-8 says, with or without a byte order mark. ConfigError for another encoding."""
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ConfigError(f"cannot read {what} {path}: {error.strerror}; {remedy}") from None
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not text in UTF-8: {error}; save it as UTF-8") from None
    if "\0" in text:
        raise ConfigError(f"{path} is not text in UTF-8: it has zeros, as UTF-16 does; save it as UTF-8")
    return text


def _checked_learner(config: Config, where: str) -> Config:
    """The configuration, its learner seen to fit the episodes it will get; ConfigError otherwise."""
    horizon, steps = config.learner.horizon_steps, config.run.steps
    if horizon > steps:
        raise ConfigError(
            f"{where}: learner.horizon_steps = {horizon} is longer than an episode of run.steps = {steps}; "
            "allowed: at most as long; lower the first or raise the second"
        )
    if config.learner.localization is Localization.TIME and config.task.directions is None:
        raise ConfigError(
            f"{where}: learner.localization = time needs a common start, found no task.directions; "
            "set task.directions to the number of directions, 36 for example"
        )
    return config


def _with_whole_paths(config: Config) -> Config:
    """The configuration with the whole path of its ground's file, so that a run finds it from any folder."""
    if config.terrain.file is None:
        return config
    try:
        file = place.at(config.terrain.file)
        return with_ground(config, file if place.is_object(file) else file.expanduser().resolve())
    except RuntimeError as error:
        raise ConfigError(f"terrain.file = {config.terrain.file} leads nowhere: {error}; correct it") from None


def with_ground(config: Config, file: Path) -> Config:
    """The configuration with its ground in another file."""
    return config.model_copy(update={"terrain": config.terrain.model_copy(update={"file": str(file)})})


def parse(text: str, overrides: Sequence[str] = (), where: str = "config.json") -> Config:
    """Configuration that a run keeps (`Config.to_json`), with overrides. ConfigError as for `load`."""
    try:
        values = durable.parsed(text)
    except ValueError as error:
        raise ConfigError(f"{where} is not JSON: {error}; restore the file from a copy") from None
    if not isinstance(values, dict):
        raise ConfigError(f"{where} is not a configuration: found a {type(values).__name__}; restore it from a copy")
    if isinstance(values.get("learner"), dict):
        values["learner"].setdefault("observation", "sensors")  # runs of before there was a choice
    config = _validated(_overridden(values, overrides), where)
    return _with_whole_paths(config) if overrides else config


def check_keys(overrides: Sequence[str], command: str, allowed: tuple[str, ...], reason: str) -> None:
    """ConfigError for an override whose key starts with nothing that is allowed."""
    for override in overrides:
        if not override.startswith(allowed):
            raise ConfigError(
                f"{command} cannot change {override.partition('=')[0]}: {reason}; "
                f"allowed: keys that start with {', '.join(allowed)}"
            )


def differences(stored: Config, wanted: Config) -> list[str]:
    """Keys whose values differ, with both values; those of NO_EFFECT may differ."""
    found = changed(stored, wanted)
    before = _flat(stored.model_dump(mode="json"))
    return [f"{key} = {value} (the run has {before[key]})" for key, value in found.items()]


def changed(stored: Config, wanted: Config) -> dict[str, JsonValue]:
    """Values of another configuration that differ, by dotted key; those of NO_EFFECT may differ."""
    a, b = (_flat(config.model_dump(mode="json")) for config in (stored, wanted))
    return {key: value for key, value in b.items() if a[key] != value and key not in NO_EFFECT}


def assigned(override: str) -> tuple[str, JsonValue]:
    """Key and value of an override `key=value`. ConfigError for another form."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ConfigError(f"--set takes key=value, found '{override}'; for example --set run.seed=3")
    try:
        value: JsonValue = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    return key.strip(), value


def _overridden(values: dict[str, JsonValue], overrides: Sequence[str]) -> dict[str, JsonValue]:
    values = copy.deepcopy(values)
    for key, value in map(assigned, overrides):
        *sections, name = key.split(".")
        table = values
        for section in sections:
            inner = table.setdefault(section, {})
            if not isinstance(inner, dict):
                raise ConfigError(f"--set {key}: {section} is not a section; allowed: {', '.join(_known_keys())}")
            table = inner
        table[name] = None if value == "" else value  # TOML has no word for none
    return values


def _validated(values: dict[str, JsonValue], where: str) -> Config:
    try:
        text = json.dumps(values)
    except TypeError as error:
        raise ConfigError(f"{where}: {error}; use numbers, strings, booleans and lists") from None
    try:
        return Config.model_validate_json(text)
    except ValidationError as error:
        raise ConfigError(f"{where}: " + "; ".join(_sentence(item) for item in error.errors())) from None


def _sentence(item: ErrorDetails) -> str:
    key = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        return f"unknown key {key}{_nearest(key, _known_keys())}; allowed: {', '.join(_siblings(key))}"
    value = "" if isinstance(item["input"], dict) else f", found {item['input']!r}"
    message = item["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    return f"{key} {message}{value}".strip()


def _siblings(key: str) -> list[str]:
    section = key.rpartition(".")[0]
    known = [name for name in _known_keys() if name.rpartition(".")[0] == section]
    return known or sorted({name.partition(".")[0] for name in _known_keys()})


def settings(section: type[BaseModel] = Config, prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    """Every setting of a section and of those in it: its dotted key, and what is known of it."""
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from settings(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def _known_keys() -> list[str]:
    return [key for key, _ in settings()]


def _nearest(name: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(name, names, n=1)
    return f" (did you mean {close[0]}?)" if close else ""


def _flat(values: Mapping[str, JsonValue], prefix: str = "") -> dict[str, JsonValue]:
    flat: dict[str, JsonValue] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value}
    return flat

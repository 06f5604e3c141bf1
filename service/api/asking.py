"""What a query says of runs: the table `runs` has a row for each, with its settings and its final evaluation.

Runs of all versions stand in it. What a run's version did not know is null.
"""

from __future__ import annotations

import enum
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, TypeAlias, Union, get_args, get_origin

import pyarrow as pa

from t6gps.service import config as configuration
from t6gps.service.training import evaluation, origin, study_origin
from t6gps.storage import catalog, durable
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.fields import scalar
from t6gps.storage.sql import views
from t6gps.storage.sql.query import About, Question

Scalar: TypeAlias = bool | int | float | str | None
Parameter: TypeAlias = Scalar | Sequence[Scalar]
"""A value of a $name in SQL."""
Parameters: TypeAlias = Mapping[str, Parameter]
Warn: TypeAlias = Callable[[str], object]
UNITS = {
    "_m_per_s": "m/s",
    "_n_per_m": "N/m",
    "_n_s_per_m": "N s/m",
    "_n_m_s": "N m s",
    "_kg_m2": "kg m2",
    "_kg": "kg",
    "_deg": "deg",
    "_n": "N",
    "_m": "m",
    "_s": "s",
}
"""Units by the ends of settings' names, the longest of which counts."""


def question(root: Path, runs: str, sql: str, parameters: Parameters, warn: Warn) -> Question:
    """A SELECT over the run of a name, or over those that match a shell pattern such as 'rough-*'.

    Of many, those that are damaged are left out, each with a warning. RunError where there is no such run.
    """
    found = catalog.matching(root, runs)

    def left_out(reason: str) -> None:
        warn(f"left out: {reason}")

    return Question(found, sql, parameters, ABOUT, left_out if catalog.is_pattern(runs) else None)


def of_run(run: Run, sql: str, parameters: Parameters) -> Question:
    """A SELECT over one run."""
    return Question([run], sql, parameters, ABOUT)


def _row(run: Run) -> Mapping[str, object]:
    """The row of a run. RunError where what it is made of cannot be read."""
    try:
        settings = durable.parsed(run.config_path.read_bytes())
        study, made = study_origin.origin(run), origin.kept(run)
        row = {
            "run": run.name,
            "study": study.study,
            "arm": study.arm,
            "seed": settings.get("run", {}).get("seed"),
            "commit": None if made is None else made.commit,
            "made_at": None if made is None else made.date,
            "schema_version": None if made is None else made.schema_version,
            **{column: _value(settings, key) for key, column in SETTINGS.items()},
            **_evaluated(run),
        }
        pa.Table.from_pylist([row], ABOUT.columns)
    except (OSError, ValueError, TypeError, AttributeError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise RunError(
            f"run {run.name} is not whole: {run.path} cannot say what it is: {reason}; restore it from a copy"
        ) from None
    return row


def _evaluated(run: Run) -> dict[str, object]:
    result = evaluation.kept(run)
    if result is None:
        return {}
    row: dict[str, object] = {"evaluation_seed": result.seed}
    for name, estimate in result.estimates().items():
        row |= {f"evaluation_{name}": estimate.mean, f"evaluation_{name}_standard_error": estimate.standard_error}
    return row


def _value(settings: Mapping[str, object], key: str) -> object:
    """The value of a setting by its dotted key, None where it is none."""
    value: object = settings
    for name in key.split("."):
        value = value.get(name) if isinstance(value, dict) else None
    return value


def _settings() -> Iterator[tuple[str, pa.Field]]:
    """Dotted key and column of every setting."""
    for key, known in configuration.settings():
        kind = _kind(known.annotation)
        ends = [end for end in sorted(UNITS, key=len, reverse=True) if key.endswith(end)]
        number = UNITS[ends[0]] if ends else "1"
        unit = "" if kind == pa.string() else number
        yield key, scalar(key.replace(".", "_"), kind, unit, known.description or f"the setting {key}", nullable=True)


def _kind(annotation: object) -> pa.DataType:
    """The type of a column with values of a setting's type."""
    form, parts = get_origin(annotation), get_args(annotation)
    if form is Annotated:
        return _kind(parts[0])
    if form in (Union, types.UnionType):
        return _kind(next(part for part in parts if part is not types.NoneType))
    if form is tuple:
        return pa.list_(_kind(parts[0]))
    if isinstance(annotation, type) and not issubclass(annotation, enum.Enum):
        kinds = {bool: pa.bool_(), int: pa.int64(), float: pa.float64()}
        return next((kind for known, kind in kinds.items() if issubclass(annotation, known)), pa.string())
    return pa.string()


def _estimates() -> Iterator[pa.Field]:
    units = {"forward_speed_m_per_s": "m/s", "cost": "m2/s2", "bar_lengths_per_s": "1/s"}
    yield scalar("evaluation_seed", pa.int64(), "1", "seed of the evaluation that ended the training", nullable=True)
    for name in evaluation.EVALUATED:
        unit = units.get(name, "1")
        yield scalar(f"evaluation_{name}", pa.float64(), unit, f"its {name}: mean over episodes", nullable=True)
        yield scalar(f"evaluation_{name}_standard_error", pa.float64(), unit, "its standard error", nullable=True)


_SETTINGS = dict(_settings())
SETTINGS = {key: column.name for key, column in _SETTINGS.items()}
"""The column of `runs` that each setting has, by its dotted key."""
ABOUT = About(
    pa.schema(
        [
            *(field for field in views.RUNS if field.name not in SETTINGS.values()),
            *_estimates(),
            *_SETTINGS.values(),
        ]
    ),
    _row,
)
"""The table `runs`: place in a study, origin, final evaluation, and every setting, its dots become underscores."""

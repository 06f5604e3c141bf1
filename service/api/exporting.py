"""Episodes of runs as datasets of other programs (docs/exports.md)."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable
from importlib import metadata
from os import PathLike
from pathlib import Path

from t6gps.service.api import asking
from t6gps.service.training import origin
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, DataError, QueryError
from t6gps.storage.exports import dataset, selection
from t6gps.storage.exports.card import Asked
from t6gps.storage.exports.dataset import FORMATS, Exported
from t6gps.storage.exports.selection import Source
from t6gps.storage.sql.query import query

LICENSE = "MIT"
"""That of this program, and of what it makes unless somebody says otherwise."""
_LICENSE = re.compile(r"[A-Za-z0-9][A-Za-z0-9.+-]*")
_log = logging.getLogger(__name__)


def export(
    form: str,
    out: str | PathLike[str],
    *,
    root: str | PathLike[str] = "runs",
    run: str = "*",
    where: str | None = None,
    license: str = LICENSE,
    progress: Callable[[int, int], object] = lambda done, total: None,
    warn: Callable[[str], object] = _log.warning,
) -> Exported:
    """Write episodes of training as a dataset in the folder `out`, whole or not at all.

    form       lerobot, minari, rllib or parquet
    run        a run's name, or a pattern such as "rough-*"; of many, those that are damaged are left out with a warning
    where      SQL that is true for the episodes that leave, over `episodes` joined with `runs`; None for all
    license    SPDX identifier of the licence of the data
    progress   is told the episodes that are written, and all

    Errors: ConfigError for another form, an `out` that exists or cannot be written, or a library that is not installed;
    RunError where no run matches, QueryError for wrong SQL, DataError where no episode is left or a run is not whole.
    """
    if form not in FORMATS:
        raise ConfigError(f"there is no format {form!r} to export to; formats: {', '.join(FORMATS)}")
    if not _LICENSE.fullmatch(license):
        raise ConfigError(f"a licence is named by its SPDX identifier, such as CC-BY-4.0, found {license!r}")
    sources = _sources(Path(root), run, where, warn)
    made_by = f"t6gps {metadata.version('t6gps')}"
    return dataset.write(FORMATS[form], Path(out), Asked(run, where, license, made_by), sources, progress)


def _sources(root: Path, pattern: str, where: str | None, warn: Callable[[str], object]) -> list[Source]:
    """The runs with episodes that leave, by name. DataError where there are none."""
    condition = "true" if where is None else where
    sql = f"SELECT run, episode_id FROM episodes JOIN runs USING (run) WHERE (\n{condition}\n) ORDER BY run, episode_id"
    chosen: dict[str, list[int]] = {}
    try:
        found = query(asking.question(root, pattern, sql, {}, warn))
    except QueryError as error:
        raise QueryError(f"the condition {condition!r} cannot be asked: {error}") from None
    for row in found.to_pylist():
        chosen.setdefault(row["run"], []).append(row["episode_id"])
    if not chosen:
        which = (
            "no iteration is committed yet" if where is None else f"none meets {where!r}; ask for others with --where"
        )
        raise DataError(f"no episode of runs {pattern!r} in {catalog.whole(root)} is left to export: {which}")
    return [_source(catalog.open_run(root, name), numbers) for name, numbers in chosen.items()]


def _source(run: Run, numbers: list[int]) -> Source:
    row, made = asking.ABOUT.row(run), origin.kept(run)
    versions = {} if made is None else made.versions
    ground = None if made is None or made.ground is None else f"{Path(made.ground.file).name}, {made.ground.sha256}"
    all_n = tables.read(run, "episodes", ["episode_id"]).num_rows
    facts = {
        "run": run.name,
        "episodes": f"{len(numbers)} of {all_n}",
        "seed": row["seed"],
        "commit": row["commit"],
        "made": row["made_at"],
        **{name: versions.get(name) for name in ("t6gps", "pybullet", "numpy")},
        "schema": row["schema_version"],
        "ground from a file, SHA-256": ground,
    }
    return selection.source(run, numbers, facts, {key: row[column] for key, column in asking.SETTINGS.items()})

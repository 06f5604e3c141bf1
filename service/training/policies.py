"""Policies of a run by their versions: from its table, else from a checkpoint.

Runs of schema version 5 and before, and those of baselines, have checkpoints alone.
"""

from __future__ import annotations

from typing import cast

from t6gps.learner.port import Manifest, packed_policy
from t6gps.storage import checkpoint, tables
from t6gps.storage.catalog import Run
from t6gps.storage.errors import CheckpointError, RunError
from t6gps.storage.records import PolicySnapshot


def versions(run: Run) -> list[int]:
    """Versions that are kept, in order."""
    return sorted(_in_table(run) | set(checkpoint.kept(run.checkpoints)))


def chosen_of(name: str, kept: list[int], version: int | None) -> int:
    """The version that is asked for of those that a run keeps, the newest by default. RunError naming them."""
    if not kept:
        raise RunError(f"run {name} has no policy yet; let it finish an iteration")
    if version is not None and version not in kept:
        raise RunError(f"run {name} keeps no policy of version {version!r}; kept: {', '.join(map(str, kept))}")
    return kept[-1] if version is None else version


def load(run: Run, version: int | None) -> PolicySnapshot:
    """The policy of a version, the newest by default. RunError naming the versions that are kept."""
    in_table, checkpoints = _in_table(run), checkpoint.kept(run.checkpoints)
    chosen = chosen_of(run.name, sorted(in_table | set(checkpoints)), version)
    if chosen in in_table:
        return tables.policy(run, chosen)
    _, manifest, arrays = checkpoint.load(checkpoints[chosen])
    try:
        return packed_policy(cast(Manifest, manifest), arrays)
    except KeyError as error:
        raise CheckpointError(f"the checkpoint of iteration {chosen} lacks {error}; use another version") from error


def _in_table(run: Run) -> set[int]:
    return set(tables.read(run, "policies", ["version"]).column("version").to_pylist())

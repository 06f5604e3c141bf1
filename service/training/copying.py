"""Copying a run from one root to another: folders, or object stores (s3://)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from t6gps.service.training import verification
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.objects import place, publishing
from t6gps.storage.objects.place import ObjectPath

Progress = Callable[[int, int], object]


def copy(run: Run, root: Path, name: str, progress: Progress) -> Run:
    """Copy a run that nobody uses below a root, whole or not at all, and verified where it comes from an object store.

    In an object store the copy grows: its readers see whole iterations, and the same command continues one that was cut
    off. Raises RunError where the name is taken, refused or of another run, and StoreError where a store refuses.
    """
    root, name = catalog.whole(root), catalog.check_name(name)
    if isinstance(run.path, ObjectPath):
        return _fetched(run, run.path, root, name, progress)
    if isinstance(root, ObjectPath):
        with catalog.unused(run), catalog.unevaluated(run):
            publishing.probe(root)
            publishing.publish(run.path, root / name, progress=progress)
        return Run(root / name)
    return catalog.copy(run, root, name)


def _fetched(run: Run, source: ObjectPath, root: Path, name: str, progress: Progress) -> Run:
    if place.is_object(root):
        raise RunError(f"{source} and {root} are both in an object store; copy the run to a folder first")
    with catalog.drafted(root, name, "copy") as draft:
        publishing.fetch(source, draft.path, progress)
        for folder in (draft.tables, draft.spool, draft.checkpoints, draft.figures):
            folder.mkdir(exist_ok=True)
        faults = verification.unsound(draft)
        if faults:
            raise RunError(
                f"run {run.name} does not come whole from {source}: {faults[0]}; where it is being published, copy it "
                "again when that has ended, else see t6gps verify"
            )
        (draft.path / ".lock").touch()
        return catalog.claimed(draft, root, name, "copy")

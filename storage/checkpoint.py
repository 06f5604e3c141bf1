"""States of the learner, one folder per iteration, of which the last three are kept.

    iteration-000007/arrays.npz       the arrays, without pickle
    iteration-000007/manifest.json    the iteration, the caller's manifest, and the SHA-256 of arrays.npz
    iteration-000007/DONE             the SHA-256 of manifest.json, written last

A folder is built under a hidden name and renamed once it is on disk. Both sums are checked before anything is
used: a checkpoint is whole and unaltered, or it is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from t6gps.storage import durable
from t6gps.storage.errors import CheckpointError

JSON: TypeAlias = "dict[str, JSON] | list[JSON] | str | int | float | bool | None"
Array: TypeAlias = NDArray[Any]
Arrays: TypeAlias = dict[str, Array]
_Record: TypeAlias = dict[str, Any]

KEPT_N = 3
_NAME = re.compile(r"iteration-[0-9]{6}")
_log = logging.getLogger(__name__)


def save(folder: Path, iteration: int, manifest: Mapping[str, JSON], arrays: Mapping[str, Array]) -> Path:
    """Save the state after `iteration` under `folder`; once this returns it survives a crash.

    A checkpoint of the same iteration is replaced; those before the last three are removed. Raises
    CheckpointError when the manifest is not finite JSON or an array holds Python objects.
    """
    path = place_of(folder, iteration)
    try:
        archive = packed(arrays)
        record = {"iteration": iteration, "manifest": dict(manifest), "sha256": {"arrays.npz": _sum(archive)}}
        text = json.dumps(record, allow_nan=False, indent=1).encode()
    except (TypeError, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path}: {error}; a manifest holds finite JSON and an array holds numbers"
        ) from error
    draft = durable.hidden(path)
    shutil.rmtree(draft, ignore_errors=True)  # of a save that was cut off
    draft.mkdir(parents=True)
    for name, content in (("arrays.npz", archive), ("manifest.json", text), ("DONE", _sum(text).encode())):
        (draft / name).write_bytes(content)
        durable.sync(draft / name)
    if path.exists():
        durable.discard(path)
    durable.publish(path)
    for old in _found(folder)[KEPT_N:]:
        durable.discard(old)
    durable.sweep(folder)
    return path


def load(path: Path) -> tuple[int, dict[str, JSON], Arrays]:
    """Iteration, manifest and arrays of the checkpoint in the folder `path`.

    Raises CheckpointError naming the file that is missing, torn or altered.
    """
    record = _record(path, _verified(path, "manifest.json", _done(path)))
    content = _verified(path, "arrays.npz", record["sha256"]["arrays.npz"])
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    return record["iteration"], record["manifest"], arrays


def load_latest(folder: Path) -> tuple[int, dict[str, JSON], Arrays] | None:
    """The newest sound checkpoint under `folder`, None when there is none at all.

    Checkpoints that are torn or altered are skipped with a warning in the log. Raises CheckpointError naming
    each when none of them is sound.
    """
    faults = []
    for path in _found(folder):
        try:
            return load(path)
        except CheckpointError as error:
            _log.warning("skipped: %s", error)
            faults.append(str(error))
    if faults:
        raise CheckpointError(
            "no checkpoint can be used; restore one from a copy, or start a new run\n" + "\n".join(faults)
        )
    return None


def kept(folder: Path) -> dict[int, Path]:
    """The folders of the checkpoints under `folder`, by iteration."""
    return {int(path.name.removeprefix("iteration-")): path for path in _found(folder)}


def manifest(path: Path) -> dict[str, JSON]:
    """The manifest of the checkpoint in the folder `path`, whose arrays are not read. CheckpointError as `load`."""
    found: dict[str, JSON] = _record(path, _verified(path, "manifest.json", _done(path)))["manifest"]
    return found


def place_of(folder: Path, iteration: int) -> Path:
    """The folder, under `folder`, of the checkpoint after that many iterations."""
    return folder / f"iteration-{iteration:06d}"


def _found(folder: Path) -> list[Path]:
    """The folders of all checkpoints, the newest first. Whatever else lies there is none, such as a copy of one."""
    return sorted((path for path in folder.glob("iteration-*") if _NAME.fullmatch(path.name)), reverse=True)


def packed(arrays: Mapping[str, Array]) -> bytes:
    """An .npz archive; numpy's own writer reserves some names of arrays for its arguments."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, np.asanyarray(array), allow_pickle=False)
    return buffer.getvalue()


def _done(path: Path) -> str:
    return _bytes(path, "DONE").decode(errors="replace")


def _record(path: Path, text: bytes) -> _Record:
    """What a manifest of that sum says: who altered both may have written anything."""
    try:
        record: _Record = durable.parsed(text)
        record["iteration"], record["manifest"].keys(), record["sha256"]["arrays.npz"]
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        raise CheckpointError(f"checkpoint {path}: manifest.json is none: {error!r}") from None
    return record


def _sum(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _bytes(path: Path, name: str) -> bytes:
    try:
        return (path / name).read_bytes()
    except OSError as error:
        raise CheckpointError(f"checkpoint {path}: {name} cannot be read: {error.strerror}") from error


def _verified(path: Path, name: str, expected: str) -> bytes:
    content = _bytes(path, name)
    if _sum(content) != expected:
        raise CheckpointError(f"checkpoint {path}: {name} is torn or altered: it fails its SHA-256")
    return content

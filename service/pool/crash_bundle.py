"""An episode that failed three times, with everything that is needed to run it alone.

    RUN/bundles/episode-7.json    plan, settings, failures, versions; `evaluation-7.json` for an evaluation
    RUN/bundles/episode-7.npz     the policy

An episode that has a bundle is not tried again, also when the run is resumed, until the bundle is removed.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from t6gps.service.pool.attempt import Failure, Runner, attempt
from t6gps.service.provenance import versions
from t6gps.storage import checkpoint, durable
from t6gps.storage.errors import RunError
from t6gps.storage.records import Episode, EpisodePlan, PolicySnapshot
from t6gps.workers.settings import RolloutSettings
from t6gps.workers.worker import RolloutWorker


@dataclass(frozen=True)
class Bundle:
    """What a bundle holds; `failures` and `versions` as they were written."""

    plan: EpisodePlan
    settings: RolloutSettings
    snapshot: PolicySnapshot
    failures: list[dict[str, Any]]
    versions: dict[str, str]


def write(
    folder: Path,
    purpose: str,
    plan: EpisodePlan,
    settings: RolloutSettings,
    snapshot: PolicySnapshot,
    failures: Sequence[Failure],
) -> Path:
    """Keep the bundle of an episode; once this returns it survives a crash."""
    folder.mkdir(exist_ok=True)
    path = folder / f"{purpose}-{plan.episode_id}.json"
    arrays = {}
    for number, (weight, bias) in enumerate(snapshot.layers):
        arrays[f"layer_{number}_weight"], arrays[f"layer_{number}_bias"] = weight, bias
    durable.hidden(path.with_suffix(".npz")).write_bytes(checkpoint.packed(arrays))
    durable.publish(path.with_suffix(".npz"))
    record = {
        "plan": asdict(plan),
        "settings": settings.model_dump(),
        "policy": {"version": snapshot.version, "offset_m": snapshot.offset_m, "scale_m": snapshot.scale_m},
        "failures": [asdict(failure) for failure in failures],
        "versions": versions(),
        "platform": platform.platform(),
    }
    durable.hidden(path).write_text(json.dumps(record, indent=1) + "\n")
    durable.publish(path)
    return path


def read(path: Path) -> Bundle:
    """A bundle from its .json file; the .npz lies beside it. RunError when either cannot be used."""
    try:
        record = durable.parsed(path.read_text())
        with np.load(path.with_suffix(".npz"), allow_pickle=False) as arrays:
            layers = tuple(
                (arrays[f"layer_{number}_weight"], arrays[f"layer_{number}_bias"]) for number in range(len(arrays) // 2)
            )
        policy = record["policy"]
        return Bundle(
            EpisodePlan(**record["plan"]),
            _on_own_ground(RolloutSettings.model_validate_json(json.dumps(record["settings"])), path),
            PolicySnapshot(policy["version"], layers, policy["offset_m"], policy["scale_m"]),
            record["failures"],
            record["versions"],
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise RunError(
            f"{path} is not a crash bundle: {error}; give RUN/bundles/episode-N.json with the .npz beside it"
        ) from None


def _on_own_ground(settings: RolloutSettings, bundle: Path) -> RolloutSettings:
    """The settings with the ground that the bundle's run keeps, wherever the run has been moved to."""
    file = settings.terrain.file
    copy = bundle.absolute().parents[1] / "ground" / Path(file or "").name
    if file is None or not copy.is_file():
        return settings
    return settings.model_copy(update={"terrain": settings.terrain.model_copy(update={"file": str(copy)})})


def kept(folder: Path, purpose: str) -> set[int]:
    """Episodes that have a bundle."""
    return {int(path.stem.rpartition("-")[2]) for path in folder.glob(f"{purpose}-*.json")}


def replay(bundle: Bundle, make_worker: Callable[[RolloutSettings], Runner] = RolloutWorker) -> Episode | Failure:
    """Run the bundle's plan once more, alone and in this process."""
    alone = make_worker(bundle.settings)
    try:
        return attempt(alone, bundle.plan, bundle.snapshot)
    finally:
        alone.close()

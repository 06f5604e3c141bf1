"""Policies as rows of the table `policies`, and back."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from t6gps.storage.errors import DataError
from t6gps.storage.records import PolicySnapshot


def row(policy: PolicySnapshot) -> dict[str, object]:
    """The row of a policy."""
    weights = np.concatenate([part.ravel() for layer in policy.layers for part in layer]).astype("<f4")
    before = policy.version - 1 if policy.version else None
    return {
        "version": policy.version,
        "iteration": before,
        "parent": before,
        "sha256": _sum(weights),
        "offset_m": policy.offset_m,
        "scale_m": policy.scale_m,
        "layers": [policy.layers[0][0].shape[1], *(len(bias) for _, bias in policy.layers)],
        "weights": weights,
    }


def policy(row: Mapping[str, Any]) -> PolicySnapshot:
    """The policy of a row. DataError where it fails its SHA-256."""
    weights = np.array(row["weights"], dtype="<f4")
    if _sum(weights) != row["sha256"]:
        raise DataError(f"policy {row['version']} fails its SHA-256; restore the run from a copy")
    layers, first = [], 0
    for inputs_n, outputs_n in pairwise(row["layers"]):
        middle, last = first + outputs_n * inputs_n, first + outputs_n * (inputs_n + 1)
        layers.append((weights[first:middle].reshape(outputs_n, inputs_n), weights[middle:last]))
        first = last
    return PolicySnapshot(row["version"], tuple(layers), row["offset_m"], row["scale_m"])


def _sum(weights: np.ndarray[tuple[int], np.dtype[np.float32]]) -> str:
    return hashlib.sha256(weights.tobytes()).hexdigest()

"""What tests of the paper's figures draw: a run, and one of its evaluations."""

from __future__ import annotations

import pytest
from tiny_run import Trained

from t6gps.service.cli.data import figures
from t6gps.service.cli.here import Here
from t6gps.service.views.paper.material import Material
from t6gps.storage import tables


@pytest.fixture(scope="module")
def material(tiny: Trained) -> Material:
    """The run `tiny` and the evaluation that ended its training."""
    iterations = tables.read(tiny.run, "iterations").sort_by("iteration")
    return figures.gathered(Here(tiny.run.path.parent), tiny.run, iterations, 0, 1)

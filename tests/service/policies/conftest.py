"""Policies in every format: of the sensors alone, and of the nodes, too."""

from __future__ import annotations

import exported_policies
import pytest
from exported_policies import Material

from t6gps.service.policies.files import Format
from t6gps.storage.schema import OBSERVATION_N, SENSORS_N


@pytest.fixture(
    scope="session", params=[[SENSORS_N, 16, 24], [OBSERVATION_N, 40, 33, 32, 24]], ids=["sensors", "shape"]
)
def material(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Material:
    """Of a policy that sees the sensors alone, and of one that sees the nodes, too."""
    return exported_policies.material(request.param, tmp_path_factory.mktemp("policies"))


@pytest.fixture(params=Format)
def form(request: pytest.FixtureRequest) -> Format:
    """Each format."""
    return Format(request.param)

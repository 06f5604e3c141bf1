"""Laws of the OpenAPI document: whatever it allows is answered as it says, and nothing is answered with 500."""

from __future__ import annotations

import os

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, assume, given, settings
from loopback import Server
from schemathesis.core.parameters import ParameterLocation
from schemathesis.generation import GenerationMode

from t6gps.service.remote.messages import Scope

ENDLESS = ["/v1/runs/{name}/events", "/v1/drives/{drive}/frames"]
"""A stream has no end; its tests are in test_updates.py and test_driving.py."""
BEYOND = [schemathesis.checks.positive_data_acceptance]
"""Not asked: which settings and which SQL there are is beyond what a document can say."""
EXAMPLES_N = int(os.environ.get("T6GPS_API_EXAMPLES", "8"))
"""Of each route, within what its document allows and beyond it; `make api` asks for more."""


@pytest.mark.slow
@pytest.mark.parametrize("mode", list(GenerationMode))
def test_whatever_is_asked_is_answered_as_the_document_says(server: Server, mode: GenerationMode) -> None:
    document = schemathesis.openapi.from_url(f"{server.url}/openapi.json").exclude(path=ENDLESS)
    headers = {"Authorization": f"Bearer {server.tokens[Scope.ADMIN]}"}
    operations = [found.ok() for found in document.get_all_operations()]
    assert len(operations) > 15
    for operation in operations:
        if mode is GenerationMode.NEGATIVE and not (operation.body or operation.path_parameters):
            continue  # nothing can be asked in another way

        @settings(
            max_examples=EXAMPLES_N,
            derandomize=True,
            database=None,
            deadline=None,
            phases=[Phase.explicit, Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(operation.as_strategy(generation_mode=mode))
        def answered(case: schemathesis.Case) -> None:
            if mode is GenerationMode.POSITIVE and "name" in case.path_parameters:
                case.path_parameters["name"] = server.run.name  # else every route says that there is no such run
            head = case.meta.components.get(ParameterLocation.HEADER)
            assume(head is None or head.mode is GenerationMode.POSITIVE)  # tokens are tested in test_access.py
            case.call_and_validate(headers=headers, excluded_checks=BEYOND, timeout=120)

        answered()

"""Laws of the settings: an option that means none is None, however it was written down."""

from __future__ import annotations

import json

import pytest
from pydantic import BaseModel, ValidationError

from t6gps.workers.settings import RolloutSettings, TaskSettings, TerrainSettings


def _groups() -> list[BaseModel]:
    return [getattr(RolloutSettings(), name) for name in RolloutSettings.model_fields]


@pytest.mark.parametrize("text", ["{}", '{"file": ""}', '{"file": null}'])
def test_no_file_is_none_in_old_and_new_records(text: str) -> None:
    assert TerrainSettings.model_validate_json(text).file is None


@pytest.mark.parametrize("text", ["{}", '{"directions": 0}', '{"directions": null}'])
def test_no_directions_are_none_in_old_and_new_records(text: str) -> None:
    assert TaskSettings.model_validate_json(text).directions is None


def test_what_is_not_none_is_kept() -> None:
    settings = RolloutSettings(task=TaskSettings(directions=36), terrain=TerrainSettings())
    assert RolloutSettings.model_validate_json(settings.model_dump_json()) == settings
    assert TerrainSettings(file="hills.npy").file == "hills.npy"


def test_an_option_that_may_be_none_is_none_by_default_so_that_records_can_leave_it_out() -> None:
    changed = RolloutSettings(terrain=TerrainSettings(file="hills.npy"))
    for settings in (RolloutSettings(), changed):
        record = settings.model_dump_json(exclude_none=True)
        assert "null" not in record
        assert RolloutSettings.model_validate(json.loads(record)) == settings
    for group in _groups():
        for name, field in type(group).model_fields.items():
            try:
                optional = type(group).model_validate({name: None})
            except ValidationError:
                continue
            assert field.default is None, name
            assert getattr(optional, name) is None


@pytest.mark.parametrize("value", [False, 0.0, -1, 361, "36"])
def test_only_the_old_value_stands_for_none(value: object) -> None:
    with pytest.raises(ValidationError):
        TaskSettings.model_validate({"directions": value})
    with pytest.raises(ValidationError):
        TerrainSettings.model_validate({"file": 0})


def test_directions_need_flat_ground() -> None:
    with pytest.raises(ValidationError, match="starts from rest on flat ground"):
        RolloutSettings(task=TaskSettings(directions=1), terrain=TerrainSettings(tilt_deg=1.0))

"""Laws of a policy's file: it says what it is, is written whole, and is refused where it is not as it was written."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from exported_policies import Material

from t6gps.service.config import Config
from t6gps.service.policies import c_header, description, driving, files, torchscript
from t6gps.service.policies import onnx as onnx_files
from t6gps.service.policies.files import Format
from t6gps.service.training.origin import Ground, Origin
from t6gps.storage.delta import policies
from t6gps.storage.errors import ConfigError, DataError
from t6gps.storage.records import PolicySnapshot
from t6gps.workers.robot.topology import CABLES
from t6gps.workers.settings import RandomisationSettings, TerrainSettings


def test_a_file_says_which_policy_of_which_robot_it_is(material: Material, form: Format) -> None:
    found = material.drivers[form].description
    assert (found.run, found.policy_version, found.control_period_s) == ("rolling", 3, 0.1)
    assert found.sha256 == policies.row(material.snapshot)["sha256"]
    assert np.array_equal(found.cables, CABLES)
    assert driving.world(found, (), Path("policy")).rollout == material.config.rollout


def test_metadata_stand_where_each_format_has_them(material: Material) -> None:
    digest = str(policies.row(material.snapshot)["sha256"])
    properties = {entry.key: entry.value for entry in onnx.load(material.files[Format.ONNX]).metadata_props}
    assert (properties["run"], properties["policy_version"], properties["sha256"]) == ("rolling", "3", digest)
    extra = {"t6gps.json": ""}
    torch.jit.load(str(material.files[Format.TORCHSCRIPT]), _extra_files=extra)
    assert json.loads(extra["t6gps.json"])["sha256"] == digest
    header = material.files[Format.C].read_text()
    assert f'#define T6GPS_SHA256 "{digest}"\n' in header
    assert "#define T6GPS_POLICY_VERSION 3\n" in header


@pytest.mark.parametrize("form", [Format.ONNX, Format.C])
def test_the_same_policy_gives_the_same_bytes(form: Format, material: Material, tmp_path: Path) -> None:
    again = files.write(form, tmp_path / material.files[form].name, "rolling", material.config, None, material.snapshot)
    assert again.read_bytes() == material.files[form].read_bytes()


def test_the_header_is_strict_c99(material: Material, tmp_path: Path) -> None:
    source = tmp_path / "robot.c"
    source.write_text(
        f'#include "{material.files[Format.C]}"\nint main(void) {{ t6gps_state state = T6GPS_START; '
        "t6gps_measurement measured = {0}; double commands[T6GPS_CABLES]; t6gps_decide(&measured, &state, commands); "
        "return t6gps_cables[0][0]; }\n"
    )
    strict = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(["gcc", *strict, str(source), "-o", str(tmp_path / "robot"), "-lm"], check=True)
    called = re.findall(r"\b(malloc|calloc|free|printf)\b", material.files[Format.C].read_text())
    assert not called


def test_a_truncated_file_is_one_error(material: Material, form: Format, tmp_path: Path) -> None:
    whole = material.files[form].read_bytes()
    cut = tmp_path / material.files[form].name
    for share in (0.0, 0.3, 0.95):
        cut.write_bytes(whole[: int(len(whole) * share)])
        with pytest.raises(DataError, match="export"):
            files.opened(cut)


def test_other_weights_than_those_described_are_one_error(material: Material, form: Format, tmp_path: Path) -> None:
    other = PolicySnapshot(3, tuple((2 * a, b) for a, b in material.snapshot.layers), 1.0, 0.2)
    described = description.describe("rolling", material.config, None, other)
    file = tmp_path / material.files[form].name
    if form is Format.C:
        file.write_text(material.files[form].read_text().replace("0.", "1.", 1))
    elif form is Format.ONNX:
        onnx_files.write(material.snapshot, material.config.robot, described, file)
    else:
        torchscript.write(material.snapshot, material.config.robot, described, file)
    with pytest.raises(DataError, match="SHA-256"):
        files.opened(file)


def test_a_file_of_a_later_version_names_it(material: Material, tmp_path: Path) -> None:
    later = material.drivers[Format.ONNX].description.model_copy(update={"schema_version": 99, "made_by": "t6gps 9.0"})
    file = tmp_path / "later.onnx"
    onnx_files.write(material.snapshot, material.config.robot, later, file)
    with pytest.raises(DataError, match=r"schema version 99, made by t6gps 9\.0.*reads up to"):
        files.opened(file)


def test_a_model_of_somebody_else_is_one_error(tmp_path: Path) -> None:
    file = tmp_path / "other.pt"
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), str(file))
    with pytest.raises(DataError, match="does not say which policy"):
        files.opened(file)
    header = tmp_path / "other.h"
    header.write_text("#define T6GPS 1\n")
    with pytest.raises(DataError, match="no header of a policy"):
        files.opened(header)
    with pytest.raises(ConfigError, match=r"allowed: \.onnx"):
        files.opened(tmp_path / "policy.pkl")
    with pytest.raises(ConfigError, match="cannot read"):
        files.opened(tmp_path / "missing.onnx")


def test_a_header_that_does_not_compile_is_one_error(tmp_path: Path, material: Material) -> None:
    text = material.files[Format.C].read_text().rpartition(c_header.SUM.partition("{")[0])[0] + "#error no\n"
    file = tmp_path / "wrong.h"
    file.write_text(text + c_header.SUM.format(c_header.digest(text)))
    with pytest.raises(DataError, match="does not compile"):
        files.opened(file)


def test_without_a_compiler_a_header_names_the_remedy(material: Material, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ConfigError, match="neither cc nor gcc; install one"):
        files.opened(material.files[Format.C])


@pytest.mark.parametrize(
    ("settings", "overrides", "words"),
    [
        ({}, ["robot.shortest_command_m=0.6"], "robot.shortest_command_m = 0.5, the simulator would by 0.6"),
        ({}, ["learner.batch=3"], "policy run cannot change learner.batch"),
        ({"randomisation": RandomisationSettings(sensor_noise=0.1)}, [], "--set randomisation.sensor_noise=0.0"),
        ({"terrain": TerrainSettings(file="/a/hills.npy")}, [], "ground of hills.npy .SHA-256 abc"),
    ],
)
def test_a_world_that_the_file_does_not_fit_is_one_error(
    settings: dict[str, RandomisationSettings | TerrainSettings],
    overrides: list[str],
    words: str,
    material: Material,
) -> None:
    config = Config(**settings)  # type: ignore[arg-type]
    ground = Ground(file="ground/hills.npy", sha256="abc")
    origin = Origin(
        schema_version=7, commit="", date="2026-11-28T00:00:00+00:00", versions={}, compiled={}, ground=ground
    )
    found = description.describe("rolling", config, origin, material.snapshot)
    assert "/a/" not in found.to_json()
    with pytest.raises(ConfigError, match=words):
        driving.world(found, overrides, Path("policy.onnx"))


def test_a_robot_that_this_simulator_does_not_know_is_one_error(material: Material) -> None:
    found = material.drivers[Format.ONNX].description
    robot = {**found.model_dump()["settings"]["robot"], "wings": 2}
    other = found.model_copy(update={"settings": {**found.settings, "robot": robot}})
    with pytest.raises(ConfigError, match=r"policy\.onnx: unknown key robot\.wings"):
        driving.world(other, (), Path("policy.onnx"))

"""Laws of the configuration: presets load, overrides reach their key, and everything else is refused by name."""

import codecs
import json
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel

from t6gps.learner.settings import ActionValueSettings
from t6gps.service import config as configuration
from t6gps.service.config import Config, differences, kept, load, parse, presets
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError


def test_the_presets_of_the_paper_have_its_sizes() -> None:
    assert presets() == [
        "flat",
        "flat-fast",
        "flat-hardware",
        "flat-quick",
        "flat-soft",
        "flat-stiff",
        "paper",
        "paper-quick",
        "rough",
        "rough-quick",
        "superball-v2",
    ]
    rough, flat, paper = load("rough"), load("flat"), load("paper")
    assert (paper.run.episodes, paper.run.steps, paper.run.iterations) == (300, 250, 5)
    assert (paper.task.target_speed_m_per_s, paper.learner.hidden_layers) == (0.8, (256, 256, 256))
    assert (paper.learner.prior_samples, paper.learner.value_from, paper.learner.replay_iterations) == (0, 0, 0)
    assert (rough.run.episodes, rough.run.steps, rough.run.iterations) == (100, 250, 15)
    assert rough.terrain.difficulty == 1.0
    assert flat.run.episodes * flat.run.steps * flat.run.iterations == 125_000
    assert flat.terrain.difficulty == 0.0


def test_a_kept_configuration_is_read_back_unchanged() -> None:
    config = load("rough", ["run.seed=3", "learner.reduced_state=nodes+vels"])
    assert parse(config.to_json()) == config


def test_a_configuration_from_before_there_were_two_observations_means_the_sensors() -> None:
    values = json.loads(Config().to_json())
    assert values["learner"].pop("observation") == "shape"
    assert configuration.parse(json.dumps(values)).learner.observation == "sensors"


@pytest.mark.parametrize(
    ("override", "section", "key", "value"),
    [
        ("run.seed=12", "run", "seed", 12),
        ("robot.friction=0.7", "robot", "friction", 0.7),
        ("robot.bar_mass_kg=5", "robot", "bar_mass_kg", 5.0),
        ("learner.reduced_state=com", "learner", "reduced_state", "com"),
        ('learner.reduced_state="com"', "learner", "reduced_state", "com"),
        ("learner.hidden_layers=[8, 8]", "learner", "hidden_layers", (8, 8)),
        ("learner.action_value.discount=0.9", "learner", "action_value", ActionValueSettings(discount=0.9)),
        ("learner.action_value.hidden_layers=[8]", "learner", "action_value", ActionValueSettings(hidden_layers=(8,))),
    ],
)
def test_an_override_reaches_its_key(override: str, section: str, key: str, value: object) -> None:
    assert getattr(getattr(load("flat-quick", [override]), section), key) == value


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("run.sed=1", ["unknown key run.sed", "did you mean run.seed", "run.iterations"]),
        ("rnu.seed=1", ["unknown key rnu", "robot"]),
        ("run.seed=-1", ["run.seed", "greater than or equal to 0", "-1"]),
        ("run.seed=abc", ["run.seed", "integer", "abc"]),
        ("run.episodes=1.5", ["run.episodes", "1.5"]),
        ("robot.friction=true", ["robot.friction", "number", "True"]),
        ("robot.friction=nan", ["robot.friction", "nan"]),
        ("terrain.difficulty=2", ["terrain.difficulty", "less than or equal to 1.5", "2"]),
        ("learner.reduced_state=knees", ["learner.reduced_state", "nodes+vels", "knees"]),
        ("run.seed", ["--set takes key=value", "run.seed"]),
        ("run.seed.deep=1", ["run.seed"]),
        ("learner.action_value.discount=1", ["learner.action_value.discount", "less than 1", "found 1"]),
        (
            "learner.action_value.discont=1",
            ["did you mean learner.action_value.discount?", "learner.action_value.batch"],
        ),
        ("learner.action_value=0.9", ["learner.action_value", "0.9"]),
    ],
)
def test_a_bad_override_is_refused_with_its_key_what_was_found_and_what_is_allowed(
    override: str, words: list[str]
) -> None:
    with pytest.raises(ConfigError) as error:
        load("flat-quick", [override])
    for word in words:
        assert word in str(error.value)


def test_commands_must_be_ordered() -> None:
    with pytest.raises(ConfigError, match="shortest_command_m must be below longest_command_m"):
        load("flat-quick", ["robot.shortest_command_m=1.0", "robot.longest_command_m=0.9"])


def test_an_unknown_preset_names_the_nearest_and_all_others() -> None:
    with pytest.raises(ConfigError, match=r"unknown preset 'flat-quik' \(did you mean flat-quick\?\).*rough-quick"):
        load("flat-quik")


def test_a_file_is_read_and_a_broken_one_refused(tmp_path: Path) -> None:
    good, broken = tmp_path / "good.toml", tmp_path / "broken.toml"
    good.write_text("[run]\nepisodes = 7\n")
    broken.write_text("[run\n")
    assert load(str(good)).run.episodes == 7
    with pytest.raises(ConfigError, match="is not TOML"):
        load(str(broken))
    broken.write_text("[run]\nseed = 2026-01-01\n")
    with pytest.raises(ConfigError, match="date is not JSON serializable; use numbers, strings, booleans and lists"):
        load(str(broken))
    with pytest.raises(ConfigError, match="cannot read"):
        load(str(tmp_path / "missing.toml"))


@pytest.mark.parametrize("bom", [b"", codecs.BOM_UTF8])
def test_a_byte_order_mark_says_nothing(bom: bytes, tmp_path: Path) -> None:
    file, run = tmp_path / "mine.toml", catalog.create(tmp_path, "one", "{}")
    file.write_bytes(bom + b"[run]\nepisodes = 7\n")
    run.config_path.write_bytes(bom + load(str(file)).to_json().encode())
    assert kept(run) == load(str(file))
    assert kept(run).run.episodes == 7


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "latin-1"])
def test_another_encoding_is_refused_by_name(encoding: str, tmp_path: Path) -> None:
    file, run = tmp_path / "mine.toml", catalog.create(tmp_path, "one", "{}")
    for path in (file, run.config_path):
        path.write_bytes("# é\n[run]\nepisodes = 7\n".encode(encoding))
    for read in (lambda: load(str(file)), lambda: kept(run)):
        with pytest.raises(ConfigError, match=r"(mine.toml|config.json) is not text in UTF-8: .* save it as UTF-8"):
            read()


@pytest.mark.parametrize("text", ["", "[]", "3", "null", '{"run": 3}', '{"run": {"seed": "x"}}', None])
def test_a_run_whose_configuration_is_damaged_is_one_clear_error(text: str | None, tmp_path: Path) -> None:
    run = catalog.create(tmp_path, "one", "{}")
    if text is None:
        run.config_path.unlink()
    else:
        run.config_path.write_text(text)
    with pytest.raises(ConfigError, match=r"one/config\.json"):
        kept(run)


def test_every_setting_says_what_it_is() -> None:
    sections: list[type[BaseModel]] = [Config]
    for section in sections:
        for name, field in section.model_fields.items():
            if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
                sections.append(field.annotation)
            else:
                assert field.description, name


def test_a_configuration_from_before_the_action_value_had_settings_means_their_defaults() -> None:
    values = json.loads(Config().to_json())
    del values["learner"]["action_value"], values["task"]["waypoint_radius_m"]
    assert differences(configuration.parse(json.dumps(values)), Config()) == []


def test_differences_name_the_key_and_both_values_and_ignore_what_data_do_not_depend_on() -> None:
    a = load("flat-quick")
    b = load("flat-quick", ["run.workers=7", 'terrain.accept=["step"]', "learner.kl_weight=0.5"])
    assert differences(a, b) == [f"learner.kl_weight = 0.5 (the run has {a.learner.kl_weight})"]
    assert configuration.differences(a, a) == []


def test_an_option_that_a_file_sets_is_none_by_an_override_without_a_value(tmp_path: Path) -> None:
    file = tmp_path / "own.toml"
    file.write_text("[robot]\ndead_winch = 3\n")
    assert load(str(file)).robot.dead_winch == 3
    assert load(str(file), ["robot.dead_winch="]).robot.dead_winch is None
    with pytest.raises(ConfigError, match=r"robot\.friction must be a valid number, found None"):
        load(str(file), ["robot.friction="])


def test_an_option_that_may_be_none_is_none_by_default_so_that_a_run_can_leave_it_out() -> None:
    assert "null" not in Config().to_json()
    for section in Config.model_fields:
        settings = getattr(Config(), section)
        for key, field in type(settings).model_fields.items():
            if type(None) in get_args(field.annotation):
                assert getattr(settings, key) is None, key


def test_loading_simulates_nothing() -> None:
    assert load("flat-quick", ["robot.bar_mass_kg=20"]).robot.bar_mass_kg == 20.0
    assert load("flat-quick", ["terrain.file=none.stl"]).terrain.file == str(Path("none.stl").resolve())

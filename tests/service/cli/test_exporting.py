"""Laws of `t6gps export` of episodes: those that are asked for leave, each format has its own options."""

from __future__ import annotations

import json
from importlib import metadata
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from command import t6gps
from tiny_run import Trained

import t6gps as front_door
from t6gps.service.api import exporting
from t6gps.storage import catalog, tables


@pytest.fixture(scope="module")
def root(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two whole runs of different friction, one that is damaged, and one without an episode."""
    root = tmp_path_factory.mktemp("exporting")
    for name in ("rough-0", "rough-1", "rough-broken"):
        catalog.copy(tiny.run, root, name)
    config = root / "rough-1" / "config.json"
    settings = json.loads(config.read_text())
    settings["robot"]["friction"] = 0.7
    config.write_text(json.dumps(settings))
    (root / "rough-broken" / "tables" / "frames" / "iteration-000001.parquet").unlink()
    catalog.create(root, "empty", tiny.run.config_path.read_text())
    return root


def exported(root: Path, out: Path, *arguments: str) -> pa.Table:
    """The rows of `episodes` in what is exported as Parquet."""
    t6gps("export", "parquet", out, "--root", root, *arguments)
    return pq.read_table(out / "episodes.parquet")


def test_runs_of_a_pattern_become_one_dataset(root: Path, tmp_path: Path, tiny: Trained) -> None:
    out = tmp_path / "rolling-v0"
    done = t6gps("export", "minari", out, "--run", "rough-*", "--license", "CC-BY-4.0", "--root", root)
    assert done.stdout.decode() == f"{out}\n"
    warning, counts, *losses = done.stderr.splitlines()
    assert warning.startswith("warning: left out: run rough-broken is not whole")
    assert counts == "18 episodes, 540 control steps, runs: 2, licence: CC-BY-4.0"
    assert all(loss.startswith("not held: ") for loss in losses)
    rows = pq.read_table(out / "episodes.parquet")
    own = tables.read(tiny.run, "episodes")
    assert rows.column("run").to_pylist() == 9 * ["rough-0"] + 9 * ["rough-1"]
    assert rows.select(own.column_names).equals(pa.concat_tables([own, own]))
    card = (out / "README.md").read_text()
    assert "| `robot.friction` | 1.0 | 0.7 |" in card
    assert "license: cc-by-4.0\n" in card


@pytest.mark.parametrize(
    ("condition", "chosen"),
    [
        ("iteration = 1 AND run <> 'rough-1'", [("rough-0", number) for number in (3, 4, 5)]),
        ("robot_friction < 0.8 AND episodes.seed <> runs.seed AND episode_id = 8", [("rough-1", 8)]),
        ("true -- all\n AND episode_id IN (SELECT min(episode_id) FROM episodes)", [("rough-0", 0), ("rough-1", 0)]),
    ],
)
def test_a_condition_may_ask_episodes_and_runs(
    condition: str, chosen: list[tuple[str, int]], root: Path, tmp_path: Path
) -> None:
    rows = exported(root, tmp_path / "chosen", "--run", "rough-?", "--where", condition)
    assert list(zip(*(rows.column(name).to_pylist() for name in ("run", "episode_id")), strict=True)) == chosen
    assert rows.column("episode_index").to_pylist() == list(range(len(chosen)))
    assert {path.name for path in (tmp_path / "chosen" / "frames").iterdir()} == {f"{run}.parquet" for run, _ in chosen}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["lerobot", "x", "--run", "rouhg-*"], ["the closest: rough-"]),
        (["lerobot", "x", "--run", "empty"], ["no episode of runs 'empty'", "no iteration is committed yet"]),
        (["rllib", "x", "--run", "rough-?", "--where", "cost < 0"], ["none meets 'cost < 0'", "--where"]),
        (["parquet", "x", "--run", "rough-?", "--where", "coost < 0"], ["coost", "cost"]),
        (["parquet", "x", "--run", "rough-?", "--where", "seed = 3"], ["Ambiguous", "episodes.seed"]),
        (
            ["parquet", "x", "--run", "rough-?", "--where", "true) OR (true); DROP TABLE runs; ("],
            ["the condition 'true) OR", "syntax error"],
        ),
        (["parquet", "x", "--run", "rough-broken"], ["run rough-broken is not whole"]),
        (["minari", "x", "--run", "rough-0"], ["NAME-v0", "'x'"]),
        (["parquet", "x", "--run", "rough-0", "--license", "my own\ntags"], ["SPDX", "CC-BY-4.0"]),
        (["parquet", ".", "--run", "rough-0"], ["exists already"]),
    ],
)
def test_what_cannot_be_exported_is_one_error_and_leaves_nothing(
    arguments: list[str], words: list[str], root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = t6gps("export", *arguments, "--root", root, code=2)
    assert done.stderr.startswith("error: ")
    assert not [word for word in words if word not in done.stderr], done.stderr
    assert not list(tmp_path.iterdir())


def test_each_format_has_its_own_options() -> None:
    episodes, robot = (t6gps("export", form, "--help").stdout.decode() for form in ("lerobot", "mjcf"))
    assert "--where" in episodes
    assert "--set" not in episodes
    assert "--set" in robot
    assert "--where" not in robot


def test_python_exports_as_the_command_does(root: Path, tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    done = front_door.export(
        "parquet",
        tmp_path / "python",
        root=root,
        run="rough-0",
        where="iteration = 0",
        progress=lambda *parts: told.append(parts),
    )
    assert (done.path, done.runs, done.episodes, done.steps) == (tmp_path / "python", 1, 3, 90)
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert exported(root, tmp_path / "command", "--run", "rough-0", "--where", "iteration = 0").equals(
        pq.read_table(tmp_path / "python" / "episodes.parquet")
    )
    with pytest.raises(front_door.ConfigError, match="formats: lerobot"):
        front_door.export("rlds", tmp_path / "other", root=root)


def test_the_licence_is_that_of_the_program_unless_another_is_named() -> None:
    assert metadata.metadata("t6gps")["License-Expression"] == exporting.LICENSE

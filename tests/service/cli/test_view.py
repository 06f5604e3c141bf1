"""Laws of `t6gps view`: it writes or opens the episodes that are named or picked."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from command import t6gps
from rerun.chunk import RrdReader
from tiny_run import Trained

from t6gps.storage import tables


@pytest.fixture(scope="module")
def root(tiny: Trained) -> Path:
    """A root with one finished run named `tiny`."""
    return tiny.run.path.parent


def names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_a_folder_gets_a_file_for_each_episode_that_is_named_or_picked(
    root: Path, tmp_path: Path, tiny: Trained
) -> None:
    out = tmp_path / "walks"
    done = t6gps("view", "tiny", "4", "0", "4", "--pick", "best:1,worst:1", "--out", out, "--root", root)
    episodes = tables.read(tiny.run, "episodes").sort_by("forward_speed_m_per_s")["episode_id"].to_pylist()
    wanted = [4, 0, *(number for number in (episodes[-1], episodes[0]) if number not in (4, 0))]
    assert done.stdout.decode().split() == [str(out / f"tiny-{number}.rrd") for number in wanted]
    assert names(out) == {f"tiny-{number}.rrd" for number in wanted}
    for number in wanted:
        reader = RrdReader(out / f"tiny-{number}.rrd")
        assert [entry.recording_id for entry in reader.recordings()] == [f"tiny-{number}"]
        assert len(reader.blueprints()) == 1


def test_episodes_of_an_evaluation_are_viewed_by_its_number(root: Path, tmp_path: Path) -> None:
    t6gps("view", "tiny", "1", "--evaluation", "0", "--out", tmp_path, "--root", root)
    assert names(tmp_path) == {"tiny-evaluation-0-1.rrd"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["name some", "--pick best:1"]),
        (["99"], ["no episode 99", "8"]),
        (["1", "99"], ["no episode 99"]),
        (["1", "--evaluation", "7"], ["keeps no evaluation 7; kept: 0"]),
        (["--pick", "fastest:3"], ["best:3,worst:3"]),
        (["--pick", "best:10"], ["9 episodes"]),
        (["--pick", "best:3", "--evaluation", "0"], ["2 episodes"]),
    ],
)
def test_a_refusal_writes_nothing(root: Path, tmp_path: Path, arguments: list[str], words: list[str]) -> None:
    done = t6gps("view", "tiny", *arguments, "--out", tmp_path / "out", "--root", root, code=2)
    assert done.stderr.startswith("error: ")
    assert all(word in done.stderr for word in words)
    assert not names(tmp_path)


def test_the_viewer_opens_what_is_removed_when_it_is_closed(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer = tmp_path / "viewer"
    viewer.write_text(f'#!/bin/sh\nls "$4" "$5" > {tmp_path}/seen\n')
    viewer.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(viewer))
    monkeypatch.setenv("DISPLAY", ":0")
    t6gps("view", "tiny", "0", "1", "--root", root)
    seen = [Path(line) for line in (tmp_path / "seen").read_text().split()]
    assert [path.name for path in seen] == ["tiny-0.rrd", "tiny-1.rrd"]
    assert not any(path.exists() for path in seen)
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert "--out episode.rrd" in t6gps("view", "tiny", "0", "--root", root, code=2).stderr


def test_without_rerun_the_remedy_is_to_install_it(root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.startswith("t6gps.workers.pictures.viewer.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "rerun", None)
    done = t6gps("view", "tiny", "0", "--out", tmp_path / "a.rrd", "--root", root, code=2)
    assert "view needs rerun; install it with: pip install 't6gps[view]'" in done.stderr
    assert not names(tmp_path)

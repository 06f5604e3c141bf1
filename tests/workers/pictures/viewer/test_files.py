"""Laws of files of recordings, and of the viewer that opens them."""

from __future__ import annotations

from pathlib import Path

import pytest

from t6gps.storage.errors import ConfigError
from t6gps.workers.pictures.viewer import files


def test_a_file_is_for_one_episode_and_a_folder_has_one_each(tmp_path: Path) -> None:
    assert files.planned(tmp_path / "a.rrd", ["walk-3"]) == [tmp_path / "a.rrd"]
    assert files.planned(tmp_path / "new", ["walk-3", "walk-7"]) == [
        tmp_path / "new" / "walk-3.rrd",
        tmp_path / "new" / "walk-7.rrd",
    ]
    (tmp_path / "old.rrd").mkdir()
    assert files.planned(tmp_path / "old.rrd", ["walk-3"]) == [tmp_path / "old.rrd" / "walk-3.rrd"]


@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("a.rrd", "holds one episode, found 2; name a folder"),
        ("a.gif", r"found the suffix '\.gif'; allowed: \.rrd, or a folder"),
        ("none/a", "there is no folder .*none; create it"),
        ("taken", "it is a file, found where a folder is wanted"),
    ],
)
def test_a_place_that_cannot_be_is_refused_before_anything_is_written(tmp_path: Path, out: str, message: str) -> None:
    (tmp_path / "taken").write_bytes(b"mine")
    with pytest.raises(ConfigError, match=message):
        files.planned(tmp_path / out, ["walk-3", "walk-7"])
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_a_recording_that_cannot_be_written_leaves_the_one_before(tmp_path: Path) -> None:
    file = tmp_path / "a.rrd"
    files.write(file, b"first")
    files.write(file, b"second")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"second"]
    with pytest.raises(ConfigError, match=r"cannot write .*choose a folder you may write to"):
        files.write(file / "b.rrd", b"third")
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"second"]


def test_without_a_display_the_remedy_is_a_file(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"no display .* --out episode\.rrd"):
        files.check_display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    files.check_display()


def stand_in(folder: Path, script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A program in the place of the viewer: Rerun takes it from a variable."""
    program = folder / "viewer"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))


def test_the_viewer_opens_the_files_and_listens_to_this_machine_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stand_in(tmp_path, f'echo "$@" > {tmp_path}/asked', monkeypatch)
    files.show([tmp_path / "a.rrd", tmp_path / "b.rrd"])
    asked = (tmp_path / "asked").read_text().split()
    assert asked == ["--new", "--bind", "127.0.0.1", str(tmp_path / "a.rrd"), str(tmp_path / "b.rrd")]


def test_a_viewer_that_fails_is_told_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(tmp_path, "exit 3", monkeypatch)
    with pytest.raises(ConfigError, match=r"exit code 3, .* --out episode\.rrd"):
        files.show([tmp_path / "a.rrd"])

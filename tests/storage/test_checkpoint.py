from __future__ import annotations

import logging
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from t6gps.storage import checkpoint
from t6gps.storage.errors import CheckpointError

MANIFEST: dict[str, checkpoint.JSON] = {"rng": {"state": 2**127 + 1}, "names": ["a", None], "rate": 0.1}
ARRAYS = {
    "file": np.array([-0.0, 5e-324]),
    "policy/0": np.ones((2, 3), np.float32),
    "scalar": np.array(7, np.uint64),
    "none": np.zeros((0, 4)),
}


def _names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_what_was_saved_is_loaded_bit_for_bit(tmp_path: Path) -> None:
    path = checkpoint.save(tmp_path / "checkpoints", 4, MANIFEST, ARRAYS)
    for iteration, manifest, arrays in (checkpoint.load(path), checkpoint.load_latest(tmp_path / "checkpoints")):  # type: ignore[misc]
        assert iteration == 4
        assert manifest == MANIFEST
        assert list(arrays) == list(ARRAYS)
        for name, array in ARRAYS.items():
            assert arrays[name].dtype == array.dtype
            assert arrays[name].shape == array.shape
            assert arrays[name].tobytes() == array.tobytes()


def test_exactly_the_last_three_are_kept(tmp_path: Path) -> None:
    for iteration in range(12):
        checkpoint.save(tmp_path, iteration, {}, {})
        kept = [f"iteration-{number:06d}" for number in range(max(0, iteration - 2), iteration + 1)]
        assert _names(tmp_path) == kept


def test_saving_an_iteration_again_replaces_it(tmp_path: Path) -> None:
    checkpoint.save(tmp_path, 1, {"try": 1}, ARRAYS)
    checkpoint.save(tmp_path, 1, {"try": 2}, {})
    assert checkpoint.load_latest(tmp_path) == (1, {"try": 2}, {})
    assert _names(tmp_path) == ["iteration-000001"]


def _flip(file: Path) -> None:
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-1])


@pytest.mark.parametrize("damage", [_flip, _cut, Path.unlink])
@pytest.mark.parametrize("name", ["arrays.npz", "manifest.json", "DONE"])
def test_a_damaged_checkpoint_is_named_and_the_newest_sound_one_is_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, damage: Callable[[Path], None], name: str
) -> None:
    for iteration in range(3):
        checkpoint.save(tmp_path, iteration, {"iteration": iteration}, ARRAYS)
    damage(tmp_path / "iteration-000002" / name)
    with caplog.at_level(logging.WARNING):
        found = checkpoint.load_latest(tmp_path)
    assert found is not None
    assert found[:2] == (1, {"iteration": 1})
    assert "iteration-000002" in caplog.text
    with pytest.raises(CheckpointError, match="iteration-000002"):
        checkpoint.load(tmp_path / "iteration-000002")


def test_nothing_is_found_where_nothing_was_saved(tmp_path: Path) -> None:
    assert checkpoint.load_latest(tmp_path) is None
    assert checkpoint.load_latest(tmp_path / "nowhere") is None


def test_only_damaged_checkpoints_are_an_error_that_names_each(tmp_path: Path) -> None:
    for iteration in range(2):
        _flip(checkpoint.save(tmp_path, iteration, {}, ARRAYS) / "arrays.npz")
    with pytest.raises(CheckpointError, match=r"(?s)iteration-000001.*iteration-000000"):
        checkpoint.load_latest(tmp_path)


KILLED = """
import os, sys
from pathlib import Path
from t6gps.storage import checkpoint

folder, name = sys.argv[1:]

def die(event, arguments):
    if event == "open" and str(arguments[0]).endswith(f".iteration-000001.partial/{name}"):
        os.kill(os.getpid(), 9)

sys.addaudithook(die)
checkpoint.save(Path(folder), 1, {}, {})
"""
"""A save that is killed when it comes to a file of its checkpoint."""


@pytest.mark.parametrize("name", ["arrays.npz", "manifest.json", "DONE"])
def test_a_save_that_was_cut_off_leaves_the_previous_one_and_can_be_repeated(tmp_path: Path, name: str) -> None:
    checkpoint.save(tmp_path, 0, {}, ARRAYS)
    killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), name], check=False)
    assert killed.returncode == -signal.SIGKILL
    latest = checkpoint.load_latest(tmp_path)
    assert latest is not None
    assert latest[0] == 0
    checkpoint.save(tmp_path, 1, {}, ARRAYS)
    assert _names(tmp_path) == ["iteration-000000", "iteration-000001"]


def test_objects_and_numbers_that_json_lacks_are_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="finite JSON"):
        checkpoint.save(tmp_path, 0, {"loss": float("nan")}, {})
    with pytest.raises(CheckpointError, match="finite JSON"):
        checkpoint.save(tmp_path, 0, {"path": tmp_path}, {})  # type: ignore[dict-item]
    with pytest.raises(CheckpointError, match="holds numbers"):
        checkpoint.save(tmp_path, 0, {}, {"objects": np.array([None, {}])})
    assert list(tmp_path.iterdir()) == []

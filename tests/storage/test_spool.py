from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from t6gps.storage import schema
from t6gps.storage.errors import DataError
from t6gps.storage.records import Episode
from t6gps.storage.spool import Spool, checked


def test_what_was_appended_is_read_back_bit_for_bit(tmp_path: Path, make_episode: Any, bits: Any) -> None:
    spool = Spool(tmp_path, 2)
    episodes = {number: make_episode(number, 2) for number in (7, 3, 12)}
    for episode in episodes.values():
        spool.append(episode)
    found = Spool(tmp_path, 2).episodes()
    assert list(found) == [3, 7, 12]
    for number, episode in episodes.items():
        assert bits(found[number].frames) == bits(episode.frames)
        assert bits(found[number].summary) == bits(episode.summary)
        assert found[number].frames.schema.equals(schema.FRAMES, check_metadata=True)


def test_views_into_larger_buffers_are_written_as_they_look(tmp_path: Path, make_episode: Any, bits: Any) -> None:
    long, spool = make_episode(1, 0, steps=50), Spool(tmp_path, 0)
    steps = long.summary.column_names.index("steps")
    summary = long.summary.set_column(steps, schema.EPISODES.field("steps"), pa.array([9], pa.int32()))
    view = Episode(pa.concat_tables([long.frames.slice(3, 4), long.frames.slice(20, 6)]), summary)
    spool.append(view)
    assert bits(spool.episodes()[1].frames) == bits(view.frames)
    assert sum(path.stat().st_size for path in tmp_path.rglob("*.arrow")) < 0.5 * long.frames.nbytes


def _stream_bytes_n(table: pa.Table) -> int:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema) as stream:
        stream.write_table(table)
    return int(sink.tell())


def test_a_spool_cut_at_any_byte_gives_whole_episodes_and_counts_the_torn_one(
    tmp_path: Path, make_episode: Any, bits: Any, caplog: pytest.LogCaptureFixture
) -> None:
    spool = Spool(tmp_path, 0)
    first, second = make_episode(1, 0), make_episode(2, 0)
    spool.append(first)
    spool.append(second)
    path = next(tmp_path.rglob("*2.arrow"))
    content = path.read_bytes()
    end_of_stream = 8  # what is lost with it is no data
    cuts = np.random.default_rng(0).integers(0, len(content) - end_of_stream, 60).tolist()
    frames_n, schema_n = _stream_bytes_n(second.frames), _stream_bytes_n(second.summary.slice(1))
    between_messages = [frames_n, frames_n + schema_n - end_of_stream]  # what is left is sound as far as it goes
    for cut in [0, 1, *cuts, *between_messages]:
        path.write_bytes(content[:cut])
        with caplog.at_level(logging.WARNING):
            found = spool.episodes()
        assert list(found) == [1]
        assert spool.torn == 1
        assert path.name in caplog.text
    assert bits(found[1].frames) == bits(first.frames)
    spool.append(second)
    assert list(spool.episodes()) == [1, 2]
    assert spool.torn == 0


def test_an_acknowledged_episode_survives_a_kill(tmp_path: Path, make_episode: Any, bits: Any) -> None:
    first = make_episode(1, 0)
    sender = Spool(tmp_path / "sender", 0)
    sender.append(first)
    script = (
        "import os, pathlib, sys\n"
        "from t6gps.storage.spool import Spool\n"
        "sender, receiver = (pathlib.Path(path) for path in sys.argv[1:])\n"
        "Spool(receiver, 0).append(Spool(sender, 0).episodes()[1])\n"
        "os.kill(os.getpid(), 9)\n"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "sender"), str(tmp_path / "receiver")]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    assert bits(Spool(tmp_path / "receiver", 0).episodes()[1].frames) == bits(first.frames)


def test_an_episode_reaches_the_disk_before_it_gets_its_name(
    tmp_path: Path, make_episode: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    spool = Spool(tmp_path, 0)
    synced: list[str] = []
    real = os.fsync

    def record(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        real(descriptor)

    monkeypatch.setattr(os, "fsync", record)
    spool.append(make_episode(1, 0))
    assert synced == [".episode-000000000001.arrow.partial", "iteration-000000"]


def test_an_unfinished_append_is_no_episode(tmp_path: Path, make_episode: Any) -> None:
    spool = Spool(tmp_path, 0)
    spool.append(make_episode(1, 0))
    path = next(tmp_path.rglob("*.arrow"))
    path.rename(path.with_name(f".{path.name}.partial"))
    assert spool.episodes() == {}
    assert spool.torn == 0


def test_an_episode_that_contradicts_itself_is_refused(make_episode: Any) -> None:
    good, other = make_episode(1, 0), make_episode(2, 0)
    broken = [
        (Episode(good.frames, other.summary), "must have episode_id 2"),
        (Episode(good.frames.slice(1), good.summary), "5 steps has 6 frames, found 5"),
        (Episode(good.frames, good.summary.slice(1)), "must have one row"),
        (Episode(good.frames.drop_columns(["face"]), good.summary), "columns must be"),
        (make_episode(1, 1), "belongs to iteration 1, expected 0"),
    ]
    for episode, reason in broken:
        with pytest.raises(DataError, match=reason):
            checked(episode, 0)


def test_clearing_forgets_this_and_earlier_iterations_but_no_later_one(tmp_path: Path, make_episode: Any) -> None:
    spools = [Spool(tmp_path, iteration) for iteration in range(3)]
    for iteration, spool in enumerate(spools):
        spool.append(make_episode(iteration, iteration))
    spools[1].clear()
    assert [len(spool.episodes()) for spool in spools] == [0, 0, 1]
    spools[1].append(make_episode(5, 1))
    assert list(spools[1].episodes()) == [5]


def test_clearing_removes_what_a_clearing_that_was_cut_off_has_left(tmp_path: Path, make_episode: Any) -> None:
    spool = Spool(tmp_path, 1)
    spool.append(make_episode(1, 1))
    left = tmp_path / ".iteration-000000.discarded"
    left.mkdir()
    (left / "episode-000000000000.arrow").write_bytes(b"rest")
    assert spool.numbers() == {1}
    spool.clear()
    assert [path.name for path in tmp_path.iterdir()] == ["iteration-000001"]

"""Laws of data under `kill -9`, and of many who write and read at once.

T6GPS_KILLS says how often each kind of work is killed; by default 20 times in all the tests' runs.
"""

from __future__ import annotations

import multiprocessing
import os
import random
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import object_stores
import pytest
import synthetic
import toil
from run_digest import digests

from t6gps.storage import catalog, tables
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.objects import publishing
from t6gps.storage.objects.place import ObjectPath
from t6gps.storage.spool import Spool

KILLS_N = int(os.environ.get("T6GPS_KILLS", "20"))
LONGEST_S = 0.15
"""Between a sign of work and the kill: several episodes, a commit, or a copy."""
PUBLISHING_SIGNS_N, KILLS_OF_A_RUN_N = 20, 5
"""Files of an iteration, about; and how often a run is killed, which grows meanwhile, and then another is."""
DEADLINE_S = 240.0


@pytest.fixture(scope="module")
def forks() -> ForkServerContext:
    """Starts processes in milliseconds: what they import is loaded once, and Delta's threads are not started there."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["toil"])
    return context


@pytest.fixture
def killed(forks: ForkServerContext) -> Callable[..., list[Any]]:
    """killed(work, n, *arguments) starts `work(say, *arguments)`, kills it after some of n signs; all that it said."""
    rng = random.Random(0)

    def kill(work: Callable[..., None], signs_n: int, *arguments: object) -> list[Any]:
        ours, theirs = forks.Pipe(duplex=False)
        process = forks.Process(target=work, args=(theirs, *arguments))
        process.start()
        theirs.close()
        said = []
        for _ in range(rng.randint(1, signs_n)):
            assert ours.poll(DEADLINE_S), "it does not work"
            said.append(ours.recv())
        time.sleep(rng.uniform(0, LONGEST_S))  # where the kill falls is chance
        process.kill()
        process.join()
        assert process.exitcode == -9, "it has ended by itself"
        while True:
            try:
                said.append(ours.recv())
            except EOFError:
                return said

    return kill


@pytest.mark.slow
def test_a_run_that_is_killed_keeps_every_acknowledged_episode_and_is_sound(tmp_path: Path, killed: Any) -> None:
    run = catalog.create(tmp_path, "run", "{}")
    acknowledged = set[int]()
    for _ in range(KILLS_N):
        acknowledged |= set(killed(toil.train, 3 * synthetic.EPISODES_N, run.path))
        assert verify(run) == []
        committed_n = tables.committed_iterations(run)
        kept = set(tables.read(run, "episodes", ["episode_id"])["episode_id"].to_pylist())
        assert acknowledged <= kept | Spool(run.spool, committed_n).numbers()
    assert tables.committed_iterations(run) > KILLS_N / 4


@pytest.mark.slow
def test_runs_whose_copying_moving_or_removal_is_killed_are_whole_or_gone(tmp_path: Path, killed: Any) -> None:
    run = catalog.create(tmp_path, "run", "{}")
    synthetic.commit(run, 0)
    rows = tables.read(run, "frames")
    for _ in range(KILLS_N):
        killed(toil.shuffle, 3, run.path)
        for other in catalog.list_runs(tmp_path):
            assert verify(other) == []
            assert tables.read(other, "frames") == rows
            if other != run:
                catalog.remove(other)


@pytest.fixture
def started(forks: ForkServerContext) -> Iterator[Callable[..., tuple[BaseProcess, Connection]]]:
    """started(work, *arguments) starts a process that works; it is ended with the test."""
    processes: list[BaseProcess] = []

    def start(work: Callable[..., None], *arguments: object) -> tuple[BaseProcess, Connection]:
        ours, theirs = forks.Pipe(duplex=False)
        process = forks.Process(target=work, args=(theirs, *arguments))
        process.start()
        theirs.close()
        processes.append(process)
        return process, ours

    yield start
    for process in processes:
        process.kill()
        process.join()


@pytest.mark.slow
def test_a_run_whose_publishing_is_killed_is_sound_in_the_store_and_comes_whole(
    tmp_path: Path, killed: Any, started: Any, objects: ObjectPath, seaweed: object_stores.Store
) -> None:
    stop, published_n = tmp_path / "stop", 0
    _, looks = started(toil.read, str(objects), stop, seaweed.environment)
    for kill in range(KILLS_N):
        if kill % KILLS_OF_A_RUN_N == 0:
            run, copied_n = synthetic.made(tmp_path, 0, f"run-{kill}"), 0
            copied, copy = objects / run.name, Run(objects / run.name)
        killed(toil.publish, PUBLISHING_SIGNS_N, run.path, str(objects), seaweed.environment)
        assert verify(copy) == []
        before_n, copied_n = copied_n, tables.committed_iterations(copy)
        assert before_n <= copied_n <= tables.committed_iterations(run)
        if (kill + 1) % KILLS_OF_A_RUN_N and kill + 1 < KILLS_N:
            continue
        stop.touch()  # a reader of one run looks often
        published_n += copied_n
        publishing.publish(run.path, copied, publishing.AT_WORK)
        assert digests(copied) == digests(run.path)
        assert all((copied / file).read_bytes() == (run.path / file).read_bytes() for file in copied.below())
    assert published_n > KILLS_N / 4
    assert looks.poll(DEADLINE_S) and looks.recv() > 0


@pytest.mark.slow
def test_four_who_write_runs_and_four_who_read_them_do_not_disturb_each_other(tmp_path: Path, started: Any) -> None:
    readers = [started(toil.read, str(tmp_path), tmp_path / "stop", {}) for _ in range(4)]
    writers = [started(toil.write, tmp_path, f"run-{number}") for number in range(4)]
    for process, said in writers:
        assert said.poll(DEADLINE_S) and said.recv() == "done"
        process.join(DEADLINE_S)
    (tmp_path / "stop").touch()
    for process, said in readers:
        assert said.poll(DEADLINE_S) and said.recv() > 0
        process.join(DEADLINE_S)
        assert process.exitcode == 0
    assert [tables.committed_iterations(run) for run in catalog.list_runs(tmp_path)] == [5] * 4

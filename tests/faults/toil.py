"""What processes do until tests kill or stop them; a module by name, so that any process can import it."""

from __future__ import annotations

import os
from multiprocessing.connection import Connection
from pathlib import Path

import synthetic

from t6gps.storage import catalog, tables
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.spool import Spool


def train(say: Connection, folder: Path) -> None:
    """Spool, commit and clear iterations without end; say each episode that is acknowledged."""
    run = Run(folder)
    with catalog.locked(run):
        for number in range(tables.committed_iterations(run), 10**6):
            spool = Spool(run.spool, number)
            for episode in synthetic.episodes(number):
                spool.append(episode)
                say.send(episode.episode_id)
            synthetic.commit(run, number)
            spool.clear()


def shuffle(say: Connection, folder: Path) -> None:
    """Copy a run, move the copy and remove it, without end."""
    run = Run(folder)
    for number in range(10**6):
        say.send(number)
        copy = catalog.copy(run, folder.parent, f"copy-{os.getpid()}-{number}")
        moved = catalog.move(copy, folder.parent, f"moved-{os.getpid()}-{number}")
        catalog.remove(moved)


def write(say: Connection, root: Path, name: str) -> None:
    """Make a run of five iterations."""
    run = catalog.create(root, name, "{}")
    for number in range(5):
        synthetic.commit(run, number)
    say.send("done")


def read(say: Connection, root: Path) -> None:
    """Read all runs of a root until it has the file `stop`; say how many looks there were."""
    looks_n = 0
    while not (root / "stop").exists():
        for run in catalog.list_runs(root):
            assert verify(run) == []
            committed_n = tables.committed_iterations(run)
            assert tables.read(run, "frames", ["episode_id"]).num_rows >= committed_n * synthetic.FRAMES_N
            looks_n += 1
    say.send(looks_n)

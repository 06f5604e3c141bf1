"""What processes do until tests kill or stop them; a module by name, so that any process can import it."""

from __future__ import annotations

import os
from collections.abc import Mapping
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import synthetic

from t6gps.storage import catalog, checkpoint, tables
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.objects import place, publishing
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


def publish(say: Connection, folder: Path, root: str, environment: Mapping[str, str]) -> None:
    """Publish a run and commit its next iteration, without end; say each file that is copied."""
    os.environ.update(environment)
    run, copy = Run(folder), place.whole(Path(root)) / folder.name
    for number in range(tables.committed_iterations(run), 10**6):
        publishing.publish(folder, copy, publishing.AT_WORK, lambda done, total: say.send((done, total)))
        synthetic.commit(run, number)
        checkpoint.save(run.checkpoints, number + 1, {"ledger": {}}, {"weights": np.arange(100.0) + number})


def write(say: Connection, root: Path, name: str) -> None:
    """Make a run of five iterations."""
    run = catalog.create(root, name, "{}")
    for number in range(5):
        synthetic.commit(run, number)
    say.send("done")


def read(say: Connection, root: str, stop: Path, environment: Mapping[str, str]) -> None:
    """Read all runs of a root, a folder or in a store, until there is a file `stop`; say how many looks there were."""
    os.environ.update(environment)
    looks_n = 0
    while not stop.exists():
        for run in catalog.list_runs(catalog.whole(Path(root))):
            assert verify(run) == []
            committed_n = tables.committed_iterations(run)
            assert tables.read(run, "frames", ["episode_id"]).num_rows >= committed_n * synthetic.FRAMES_N
            looks_n += 1
    say.send(looks_n)

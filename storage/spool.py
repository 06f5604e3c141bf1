"""The durable queue of one iteration's episodes, between their sampling and their commit.

One file per episode: the frames and the summary as two Arrow IPC streams. A file is forced to disk under a
hidden name and then renamed, so that an episode is there whole or not at all.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

import pyarrow as pa

from t6gps.storage import durable, fields, ipc, schema
from t6gps.storage.errors import DataError
from t6gps.storage.objects import place
from t6gps.storage.records import Episode

_NAME = re.compile(r"iteration-[0-9]{6}")
_log = logging.getLogger(__name__)


def checked(episode: Episode, iteration: int) -> Episode:
    """Return `episode` when both its tables follow their schemas and agree with each other and with
    `iteration`.

    Raises DataError naming the episode and what disagrees.
    """
    if episode.summary.num_rows != 1:
        raise DataError(f"the summary of an episode must have one row, found {episode.summary.num_rows}")
    fields.check(episode.summary, schema.EPISODES, "summary of an episode")
    summary = episode.summary.to_pylist()[0]
    where = f"episode {summary['episode_id']}"
    fields.check(episode.frames, schema.FRAMES, f"frames of {where}")
    if summary["iteration"] != iteration:
        raise DataError(f"{where}: belongs to iteration {summary['iteration']}, expected {iteration}")
    if episode.frames.num_rows != summary["steps"] + 1:
        raise DataError(
            f"{where}: an episode of {summary['steps']} steps has {summary['steps'] + 1} frames, "
            f"found {episode.frames.num_rows}"
        )
    for name in ("episode_id", "iteration"):
        if (episode.frames.column(name).to_numpy() != summary[name]).any():
            raise DataError(f"{where}: every frame must have {name} {summary[name]}, as its summary has")
    return episode


def read(path: Path) -> Episode:
    """The episode in a file of a spool; its tables lie in the file. ArrowException or OSError when it is torn."""
    source = pa.BufferReader(path.read_bytes()) if place.is_object(path) else pa.memory_map(str(path))
    return Episode(*ipc.unpack(source, 2))


def files(folder: Path) -> list[Path]:
    """The files of a run's spool, by iteration. Whatever else lies there is none, such as the copy of a folder."""
    return sorted(path for path in folder.glob("iteration-*/episode-*.arrow") if _NAME.fullmatch(path.parent.name))


def iteration_of(file: Path) -> int:
    """The iteration in whose folder a file of a spool lies."""
    return int(file.parent.name.removeprefix("iteration-"))


def newest(folder: Path) -> Episode | None:
    """The episode that came last of those in a run's spool, for who only looks; None where none waits there."""
    for path in sorted(files(folder), key=_came, reverse=True):
        try:
            return read(path)
        except FileNotFoundError:  # committed meanwhile
            continue
    return None


def waiting(folder: Path, episode_id: int) -> Episode | None:
    """An episode that waits in a run's spool, for who only looks; None where it does not."""
    for path in files(folder):
        if path.name != f"episode-{episode_id:012d}.arrow":
            continue
        try:
            return read(path)
        except FileNotFoundError:  # committed meanwhile
            continue
    return None


def _came(path: Path) -> float:
    """When a file came, -inf for one that has gone."""
    try:
        return path.stat().st_mtime
    except FileNotFoundError:
        return float("-inf")


class Spool:
    """Episodes of one iteration that were acknowledged and are not committed yet.

    torn    files that the last call of `episodes` could not read; their episodes must be sampled again
    """

    def __init__(self, folder: Path, iteration: int) -> None:
        self.iteration = iteration
        self.torn = 0
        self._root = folder
        self._folder = folder / f"iteration-{iteration:06d}"
        self._folder.mkdir(parents=True, exist_ok=True)
        durable.sync(folder)

    def path(self, episode_id: int) -> Path:
        """The file of an episode."""
        return self._folder / f"episode-{episode_id:012d}.arrow"

    def append(self, episode: Episode) -> None:
        """Keep a `checked` episode; once this returns, it survives a crash. The same one again replaces its file."""
        path = self.path(episode.episode_id)
        packed = episode.packed
        durable.hidden(path).write_bytes(ipc.pack(episode.frames, episode.summary) if packed is None else packed)
        durable.publish(path)

    def episodes(self) -> dict[int, Episode]:
        """Every whole episode by its number; files that cannot be read are logged and counted in `torn`."""
        return {episode.episode_id: episode for episode in self._whole()}

    def numbers(self) -> set[int]:
        """Numbers of the whole episodes, of which none is held."""
        return {episode.episode_id for episode in self._whole()}

    def files(self) -> list[Path]:
        """The files of all episodes in ascending order, torn ones among them."""
        return sorted(self._folder.glob("episode-*.arrow"))

    def _whole(self) -> Iterator[Episode]:
        self.torn = 0
        for path in self.files():
            try:
                episode = checked(read(path), self.iteration)
            except (pa.ArrowException, OSError, DataError) as error:
                self.torn += 1
                _log.warning("%s is torn and will be sampled again: %s", path, error)
                continue
            yield episode

    def clear(self) -> None:
        """Forget the episodes of this iteration, and of earlier ones whose clearing was cut off."""
        for folder in sorted(self._root.glob("iteration-*")):
            if _NAME.fullmatch(folder.name) and folder.name <= self._folder.name:
                durable.discard(folder)
        durable.sweep(self._root)
        self._folder.mkdir()
        durable.sync(self._root)

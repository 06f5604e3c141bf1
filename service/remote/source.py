"""A run of a server as files: to fetch it whole, or to have its world at hand."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import final

from t6gps.service.launch import fetch
from t6gps.service.launch.fetch import File
from t6gps.service.remote.client import Client
from t6gps.storage.catalog import Run


@final
@dataclass(frozen=True)
class FarSource:
    """The `Source` of a run of a server."""

    client: Client
    name: str

    def files(self) -> dict[str, File]:
        return self.client.files(self.name)

    def pieces(self, path: str, offset: int) -> Iterator[bytes]:
        return self.client.pieces(self.name, path, offset)


@contextmanager
def at_hand(client: Client, name: str) -> Iterator[Run]:
    """The run in a folder of this machine meanwhile, without its data: its configuration, origin and ground.

    RunError where a file comes altered.
    """
    with tempfile.TemporaryDirectory(prefix="t6gps-") as folder:
        run = Run(Path(folder) / name)
        for path, expected in client.files(name, whole=False).items():
            fetch.bring(FarSource(client, name), run.path, path, expected)
        yield run

"""Policies that a server lets drive."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import final
from urllib.parse import quote

from pydantic import JsonValue

from t6gps.service.driving.commands import Command
from t6gps.service.remote.connection import Connection, checked
from t6gps.service.remote.messages import DriveBegun, DriveEntry, DriveRequest
from t6gps.service.remote.stream import START, Update


@final
@dataclass(frozen=True)
class Driving:
    """Drives of a server; to begin or steer one needs a token with scope operate."""

    server: Connection

    def begin(self, entries: Sequence[tuple[str, int | None]], episode: int, **more: JsonValue) -> str:
        """Let policies run, each of a run and a version, from the start of an episode; the drive's identifier.

        `more` has the other fields of DriveRequest.
        """
        wanted = [checked(DriveEntry, run=run, version=version) for run, version in entries]
        request = checked(DriveRequest, entries=wanted, episode=episode, **more)
        return self.server.post("/drives", DriveBegun, request).id

    def frames(self, drive: str) -> Iterator[Update]:
        """What is seen of a drive, until it ends."""
        return self.server.events(f"{_path(drive)}/frames", START)

    def steer(self, drive: str, **command: JsonValue) -> None:
        """Change what the fields of a Command say."""
        self.server.ask("POST", _path(drive), checked(Command, **command))

    def end(self, drive: str) -> None:
        """End it."""
        self.server.ask("DELETE", _path(drive))


def _path(drive: str) -> str:
    return f"/drives/{quote(drive, safe='')}"

"""The drives of a server: few at a time, since each costs a core."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

from t6gps.service.driving.drive import Drive, Patience
from t6gps.service.driving.order import Order
from t6gps.storage.errors import ServerError

DRIVES_MOST_N = 2


@dataclass(frozen=True)
class Steered:
    """A drive, and the identifier and name of the token that began it and steers it."""

    drive: Drive
    token: str
    name: str


@final
class Drives:
    """The drives under way, by their identifiers."""

    def __init__(self, patience: Patience) -> None:
        self._patience = patience
        self._drives: dict[str, Steered] = {}

    def check_room(self) -> None:
        """ServerError where there are as many drives as may be."""
        if len(self._drives) >= DRIVES_MOST_N:
            names = " and ".join(sorted(one.name for one in self._drives.values()))
            raise ServerError(f"{DRIVES_MOST_N} drives are under way, by {names}, and no more may be; end one first")

    def begin(self, order: Order, token: str, name: str, holds: Callable[[], bool]) -> str:
        """Begin a drive for a token; its identifier. ServerError where there are as many as may be."""
        self.check_room()
        identity = secrets.token_hex(8)
        drive = Drive(order, self._patience, holds, lambda: self._forget(identity))
        self._drives[identity] = Steered(drive, token, name)
        return identity

    def get(self, identity: str) -> Steered | None:
        """A drive that is under way, None where it has ended or never was."""
        return self._drives.get(identity)

    def _forget(self, identity: str) -> None:
        del self._drives[identity]

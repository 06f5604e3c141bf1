"""Server-sent events, read as they come."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pydantic import JsonValue

START = "0-0"
"""The id of who has been told nothing."""
REFUSED = "refused"
"""The last event of a stream whose token holds no more; its data is the reason."""


@dataclass(frozen=True)
class Update:
    """One event of a stream: something that happened to a run, or a frame of a drive.

    kind   of a run: iteration, with a row of the table `iterations`; pool, with an event; status, with a status; fault,
           with a sentence. Of a drive: scene, frame, steered, end (docs/server.md). Of both: refused, with a
           sentence, which the client raises
    id     where a stream may be resumed, so that each comes once; None where it may not
    """

    kind: str
    data: JsonValue
    id: str | None = None


def parsed(lines: Iterable[str]) -> Iterator[Update]:
    """The events that lines make; a blank line ends one, and lines that begin with ':' are comments."""
    fields: dict[str, str] = {}
    for line in lines:
        if line and not line.startswith(":"):
            name, _, value = line.partition(": ")
            fields[name] = value
        elif not line and "data" in fields:
            yield Update(fields["event"], json.loads(fields["data"]), fields.get("id"))
            fields = {}

"""Server-sent events, read as they come."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from pydantic import JsonValue


@dataclass(frozen=True)
class Update:
    """Something that happened to a run.

    kind   iteration, with a row of the table `iterations`; status, with a status; fault, with a sentence
    id     the iteration's number, after which a stream may be resumed; None for the others
    """

    kind: str
    data: JsonValue
    id: int | None = None


def parsed(lines: Iterable[str]) -> Iterator[Update]:
    """The events that lines make; a blank line ends one, and lines that begin with ':' are comments."""
    fields: dict[str, str] = {}
    for line in lines:
        if line and not line.startswith(":"):
            name, _, value = line.partition(": ")
            fields[name] = value
        elif not line and "data" in fields:
            identity = fields.get("id")
            yield Update(fields["event"], json.loads(fields["data"]), None if identity is None else int(identity))
            fields = {}

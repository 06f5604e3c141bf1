"""What goes on at a server for a while: the log of a job, and what happens to a run, over connections that break."""

from __future__ import annotations

import codecs
import time
from collections.abc import Iterator

from t6gps.service.launch.job import ENDED
from t6gps.service.remote.client import Client
from t6gps.service.remote.connection import UnreachableError
from t6gps.service.remote.stream import START, Update

LOOK_S = 0.5
PATIENCE_S = 30.0
"""How long a server may be out of reach."""


def logs(client: Client, name: str, follow: bool = False, look_s: float = LOOK_S) -> Iterator[str]:
    """What the job of a run has written so far; with `follow` also what it goes on to write, until it ends."""
    decoder, after = codecs.getincrementaldecoder("utf-8")("replace"), 0
    while True:
        ended = not follow or _ended(client, name)
        while piece := client.log(name, after):
            after += len(piece)
            yield decoder.decode(piece)
        if ended:  # asked before the last reading
            return
        time.sleep(look_s)


def _ended(client: Client, name: str) -> bool:
    job = client.standing(name).job
    return job is None or job.state in ENDED


def updates(client: Client, name: str, patience_s: float = PATIENCE_S, look_s: float = LOOK_S) -> Iterator[Update]:
    """What happens to a run, each once: a connection that breaks is followed by one that goes on after it.

    UnreachableError where the server is out of reach for `patience_s`.
    """
    last, heard_s = START, time.monotonic()
    while True:
        try:
            for update in client.events(name, last):
                last, heard_s = update.id or last, time.monotonic()
                yield update
                heard_s = time.monotonic()
        except UnreachableError:
            if time.monotonic() - heard_s > patience_s:
                raise
        time.sleep(look_s)

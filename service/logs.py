"""How processes of this package log: text for people, or JSON for programs, an object a line on standard error.

T6GPS_LOG_FORMAT says which: `text`, which is the default, or `json`. An object has `time` (UTC), `level`, `logger` and
`message`; `run`, `role`, `slot` and `episode` where they are known; and `exception`, a traceback. Each process of ours
calls `begin`, those on Ray with the `Speaker` that their parent gives them. A program that imports this package sets up
`logging` as it likes: nothing here is called there.
"""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from enum import StrEnum

from t6gps.storage.errors import ConfigError

VARIABLE = "T6GPS_LOG_FORMAT"
FIELDS = ("run", "role", "slot", "episode")


class Format(StrEnum):
    """How lines look."""

    TEXT = "text"
    JSON = "json"


class Role(StrEnum):
    """What a process does, or a part of it where one process does everything."""

    COMMAND = "command"
    SUPERVISOR = "supervisor"
    WORKER = "worker"
    LEARNER = "learner"
    POLICY_SERVER = "policy server"
    NODE_AGENT = "node agent"
    SERVER = "server"


@dataclass(frozen=True)
class Speaker:
    """Who logs: a role, of a run, in a slot, at work on an episode, each None where it has none."""

    format: Format = Format.TEXT
    role: Role = Role.COMMAND
    run: str | None = None
    slot: int | None = None
    episode: int | None = None


_process = Speaker()
"""Who this process is; a thread may be more exact by `speaking`."""
_here: ContextVar[Speaker | None] = ContextVar("speaker", default=None)


def chosen() -> Format:
    """The format that the environment asks for. ConfigError for another word."""
    text = os.environ.get(VARIABLE) or Format.TEXT
    try:
        return Format(text)
    except ValueError:
        raise ConfigError(f"{VARIABLE} takes {' or '.join(Format)}, found {text!r}; correct or unset it") from None


def begin(speaker: Speaker) -> None:
    """Let this process speak as that one from now on, in its format; text is left to Python's own last resort."""
    global _process  # noqa: PLW0603 # a process is one speaker
    _process = speaker
    root, package = logging.getLogger(), logging.getLogger("t6gps")
    for handler in [handler for handler in root.handlers if isinstance(handler, _Lines)]:
        root.removeHandler(handler)
    logging.captureWarnings(as_json())
    package.setLevel(logging.INFO if as_json() else logging.NOTSET)
    if as_json():
        root.addHandler(_Lines())
        adopt("ray")


def become(role: Role, run: str | None = None) -> None:
    """Let this process have another role, of that run."""
    begin(replace(_process, role=role, run=run))


def speaker() -> Speaker:
    """Who speaks here."""
    return _here.get() or _process


def other(role: Role, run: str | None = None, slot: int | None = None, episode: int | None = None) -> Speaker:
    """One that works for the speaker here, by default on the same run."""
    here = speaker()
    return Speaker(here.format, role, here.run if run is None else run, slot, episode)


@contextmanager
def speaking(speaker: Speaker) -> Iterator[None]:
    """Let lines of this thread be those of another speaker meanwhile."""
    token = _here.set(speaker)
    try:
        yield
    finally:
        _here.reset(token)


def as_json() -> bool:
    """True where lines are objects."""
    return _process.format is Format.JSON


def said(line: str) -> str:
    """What a line of a log says: the message of an object, any other line as it is."""
    try:
        known = json.loads(line)
    except ValueError:
        return line
    return str(known["message"]) if isinstance(known, dict) and "message" in known else line


def adopt(library: str) -> None:
    """Let a library's logger speak as this package does, where lines are objects."""
    if as_json():
        logger = logging.getLogger(library)
        logger.handlers.clear()
        logger.propagate = True


class _Lines(logging.Handler):
    """Writes objects to the standard error of the moment."""

    def emit(self, record: logging.LogRecord) -> None:
        """Write a line."""
        try:
            sys.stderr.write(self._line(record) + "\n")
            sys.stderr.flush()
        except (OSError, ValueError, TypeError):  # the disk is full, the stream is closed, a message does not fit
            self.handleError(record)

    def _line(self, record: logging.LogRecord) -> str:
        said = speaker()
        line: dict[str, object] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        for field in FIELDS:
            value = getattr(record, field, None)  # given as `extra`
            value = getattr(said, field) if value is None else value
            if value is not None:
                line[field] = value
        if record.exc_info:
            line["exception"] = logging.Formatter().formatException(record.exc_info)
        return json.dumps(line)

"""What the supervisor observed and decided, one line a round, so that a failure can be looked at and replayed.

RUN/pool/decisions.jsonl     {"state"}: the supervisor's state when the file begins
                             {"now", "observed", "decided"}: a round, times in seconds of a clock of its own

A file that has grown large is renamed to `decisions.1.jsonl`, and a new one begins with the state of that moment. The
same happens when the run is resumed. Rounds in which nothing was observed or decided are not written where they
cannot change the state.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO

from pydantic import TypeAdapter

from t6gps.service.pool import messages
from t6gps.service.pool.messages import Instruction, Observation
from t6gps.service.pool.state import PoolState
from t6gps.service.pool.supervisor import decide
from t6gps.storage.errors import RunError

LARGEST_BYTES = 16 * 2**20


class DecisionLog:
    """Writes the log of a run's supervisor in a folder."""

    def __init__(self, folder: Path, largest_bytes: int = LARGEST_BYTES) -> None:
        folder.mkdir(exist_ok=True)
        self._path, self._largest_bytes = folder / "decisions.jsonl", largest_bytes
        self._file: BinaryIO | None = None
        self._state_bytes = 0

    def before(self, state: PoolState) -> None:
        """A round begins: where the file does, write the state down."""
        if self._file is not None and self._file.tell() < max(self._largest_bytes, 2 * self._state_bytes):
            return
        self.close()
        if self._path.exists():
            self._path.replace(self._path.with_suffix(".1.jsonl"))
        self._file = self._path.open("wb")
        self._write(b'{"state":' + _adapter(PoolState).dump_json(state) + b"}")
        self._state_bytes = self._file.tell()

    def after(
        self, state: PoolState, now: float, observed: Sequence[Observation], decided: Sequence[Instruction]
    ) -> None:
        """A round is over."""
        if observed or decided or state.autoscale:
            self._write(b'{"now":%r,"observed":%b,"decided":%b}' % (now, _encode(observed), _encode(decided)))

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, line: bytes) -> None:
        assert self._file is not None, "`before` opens the file"
        self._file.write(line + b"\n")
        self._file.flush()


def replay(path: Path) -> int:
    """Decide everything in a log again; the number of rounds.

    RunError naming the first round that is decided otherwise, or a line that cannot be read.
    """
    rounds_n, state = 0, None
    for number, text in enumerate(path.read_bytes().splitlines(), 1):
        try:
            line = json.loads(text)
            if state is None:
                state = _adapter(PoolState).validate_python(line["state"])
                continue
            now, observed = line["now"], [_decode(message) for message in line["observed"]]
            expected = line["decided"]
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"{path}: line {number} is no round of a decision log: {error}") from error
        decided = json.loads(_encode(decide(state, observed, now)))
        if decided != expected:
            raise RunError(f"{path}: line {number} is decided otherwise: logged {expected}, now {decided}")
        rounds_n += 1
    return rounds_n


def _encode(sent: Sequence[Observation | Instruction]) -> bytes:
    """A JSON list of messages, each with its kind."""
    return b"[" + b",".join(map(_encode_one, sent)) + b"]"


def _encode_one(message: Observation | Instruction) -> bytes:
    kind: type = type(message)
    return b'{"kind":"%b",%b' % (kind.__name__.encode(), _adapter(kind).dump_json(message)[1:])


def _decode(encoded: dict[str, Any]) -> Any:
    fields = dict(encoded)
    return _adapter(getattr(messages, fields.pop("kind"))).validate_python(fields)


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)

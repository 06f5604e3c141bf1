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
from typing import Any, TextIO

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
        self._file: TextIO | None = None

    def before(self, state: PoolState) -> None:
        """A round begins: where the file does, write the state down."""
        if self._file is not None and self._file.tell() < self._largest_bytes:
            return
        self.close()
        if self._path.exists():
            self._path.replace(self._path.with_suffix(".1.jsonl"))
        self._file = self._path.open("w")
        self._write({"state": _adapter(PoolState).dump_python(state, mode="json")})

    def after(
        self, state: PoolState, now: float, observed: Sequence[Observation], decided: Sequence[Instruction]
    ) -> None:
        """A round is over."""
        if observed or decided or state.autoscale:
            self._write({"now": now, "observed": _encode(observed), "decided": _encode(decided)})

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def _write(self, line: dict[str, Any]) -> None:
        assert self._file is not None, "`before` opens the file"
        self._file.write(json.dumps(line, separators=(",", ":")) + "\n")
        self._file.flush()


def replay(path: Path) -> int:
    """Decide everything in a log again; the number of rounds.

    RunError naming the first round that is decided otherwise, or a line that cannot be read.
    """
    rounds_n, state = 0, None
    for number, text in enumerate(path.read_text().splitlines(), 1):
        try:
            line = json.loads(text)
            if state is None:
                state = _adapter(PoolState).validate_python(line["state"])
                continue
            now, observed = line["now"], [_decode(message) for message in line["observed"]]
            expected = line["decided"]
        except (ValueError, KeyError, TypeError) as error:
            raise RunError(f"{path}: line {number} is no round of a decision log: {error}") from error
        decided = json.loads(json.dumps(_encode(decide(state, observed, now))))
        if decided != expected:
            raise RunError(f"{path}: line {number} is decided otherwise: logged {expected}, now {decided}")
        rounds_n += 1
    return rounds_n


def _encode(sent: Sequence[Observation | Instruction]) -> list[dict[str, Any]]:
    kinds: list[type] = [type(message) for message in sent]
    return [
        {"kind": kind.__name__, **_adapter(kind).dump_python(message, mode="json")}
        for kind, message in zip(kinds, sent, strict=True)
    ]


def _decode(encoded: dict[str, Any]) -> Any:
    fields = dict(encoded)
    return _adapter(getattr(messages, fields.pop("kind"))).validate_python(fields)


@cache
def _adapter(kind: type) -> TypeAdapter[Any]:
    return TypeAdapter(kind)

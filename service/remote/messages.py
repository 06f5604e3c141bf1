"""What goes over the wire between client and server, beside the statuses and tables that everybody knows."""

from __future__ import annotations

from datetime import datetime
from enum import StrEnum
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, JsonValue, StringConstraints, WithJsonSchema

from t6gps.service.config import WORKERS_MOST_N, presets
from t6gps.service.driving.commands import ROBOTS_MOST_N, Difficulty, Friction
from t6gps.service.steering.requests import SCALE_DEADLINE_S, STOP_DEADLINE_S
from t6gps.storage.catalog import NAME_LENGTH_N
from t6gps.storage.sql.query import SQL_BYTES_N

WARNINGS = "T6GPS-Warnings"
"""The header that says of an answer what it is without: a list in JSON."""
WAIT_S = 60.0
"""The longest that a request may wait for its effect."""
LIFETIME_DAYS_MOST = 366.0

RunName = Annotated[str, StringConstraints(max_length=NAME_LENGTH_N, pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]*$")]
Pattern = Annotated[str, StringConstraints(min_length=1, max_length=NAME_LENGTH_N)]
ParameterName = Annotated[str, StringConstraints(max_length=NAME_LENGTH_N, pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
ColumnName = Annotated[str, StringConstraints(max_length=100, pattern=r"^[a-z][a-z0-9_]*$")]
TokenName = Annotated[str, StringConstraints(max_length=NAME_LENGTH_N, pattern=r"^[A-Za-z0-9][A-Za-z0-9._@-]*$")]
Preset = Annotated[str, WithJsonSchema({"type": "string", "enum": presets()})]
Key = Annotated[str, StringConstraints(max_length=100, pattern=r"^[a-z_]+(\.[a-z_]+)+$")]
Number = Annotated[float, Field(allow_inf_nan=False)]
CursorText = Annotated[str, StringConstraints(pattern=r"^[0-9]{1,9}-[0-9]{1,9}$")]
Text = Annotated[str, StringConstraints(max_length=200)]
Scalar = bool | int | Number | Text
NUMBER_MOST = 10**9
"""Of an episode, an evaluation or a version."""


class Scope(StrEnum):
    """What a token allows. Each scope includes those before it."""

    READ = "read"
    OPERATE = "operate"
    ADMIN = "admin"

    def includes(self, other: Scope) -> bool:
        """True when a token of this scope may do what needs the other."""
        order = list(Scope)
        return order.index(self) >= order.index(other)


class Message(BaseModel):
    """Frozen, strict, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class Refusal(Message):
    """Why a request was refused: a sentence, and the class of `storage.errors` that it belongs to."""

    error: str
    kind: str


class Health(Message):
    """The server is alive; its version."""

    version: str


class StartRequest(Message):
    """A run to start: a preset or the text of a file, and settings by dotted keys.

    name           of the run; without one `default_name`, else the preset's, with a number where that is taken
    resume         go on with the run of that name, which has the same settings, if there is one
    """

    preset: Preset | None = None
    toml: Annotated[str, StringConstraints(max_length=20_000)] | None = None
    name: RunName | None = None
    default_name: RunName | None = None
    settings: dict[Key, Scalar | list[Scalar]] = Field(default={}, max_length=100)
    resume: bool = False


class Started(Message):
    """The run that is at work now; `job` trains it, None where it was only paused. `warnings` for who asked."""

    name: str
    job: str | None
    warnings: list[str] = []


class WaitRequest(Message):
    """How long to wait for what is asked (s)."""

    deadline_s: Number = Field(SCALE_DEADLINE_S, ge=0.0, le=WAIT_S)


class ScaleRequest(WaitRequest):
    """Workers from now on, and how long to wait for them (s)."""

    workers: int = Field(ge=0, le=WORKERS_MOST_N)


class StopRequest(Message):
    """How long to wait until the run has stopped by itself (s); then its job is ended."""

    deadline_s: Number = Field(STOP_DEADLINE_S, ge=0.0, le=WAIT_S)


class Stopped(Message):
    """How a run that was stopped is then, in words, and what went otherwise than asked."""

    sentence: str
    warnings: list[str]


class QueryForm(StrEnum):
    """Forms of a query's result; a head is the first rows as texts for people."""

    ARROW = "arrow"
    PARQUET = "parquet"
    CSV = "csv"
    JSON = "json"
    HEAD = "head"


class QueryRequest(Message):
    """One SELECT over a run, or over those that match a pattern, with values of its $names; the form of its result."""

    runs: Pattern
    sql: Annotated[str, StringConstraints(max_length=SQL_BYTES_N)]
    parameters: dict[ParameterName, Scalar | list[Scalar]] = Field(default={}, max_length=100)
    form: Annotated[QueryForm, Field(strict=False)] = QueryForm.ARROW


class DriveEntry(Message):
    """A policy of a run that is to be driven, the newest by default."""

    run: RunName
    version: Annotated[int, Field(ge=0, le=NUMBER_MOST)] | None = None


class DriveRequest(Message):
    """Policies to drive from the start of an episode of the first one's run, of training or of an evaluation.

    friction, terrain_difficulty   other ones than that episode had
    """

    entries: list[DriveEntry] = Field(min_length=1, max_length=ROBOTS_MOST_N)
    episode: int = Field(ge=0, le=NUMBER_MOST)
    evaluation: Annotated[int, Field(ge=0, le=NUMBER_MOST)] | None = None
    friction: Friction | None = None
    terrain_difficulty: Difficulty | None = None


class DriveBegun(Message):
    """The drive that has begun."""

    id: str


class TokenRequest(Message):
    """A token to issue."""

    name: TokenName
    scope: Annotated[Scope, Field(strict=False)]
    days: Number = Field(gt=0.0, le=LIFETIME_DAYS_MOST)


class TokenLine(BaseModel):
    """What may be known of a token."""

    name: str
    scope: Scope
    created: datetime
    expires: datetime


class IssuedToken(TokenLine):
    """A new token, and its text, which is nowhere kept."""

    token: str


class AuditLine(BaseModel):
    """A change that somebody asked for: when (UTC), who, from where, what, and the status that answered it."""

    time: datetime
    token: str
    address: str
    method: str
    path: str
    details: dict[str, JsonValue]
    status: int

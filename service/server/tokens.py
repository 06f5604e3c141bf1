"""Bearer tokens of a root: issued once, kept as hashes, checked in constant time.

ROOT/.server/tokens.json   name, scope, times and SHA-256 of each; readable by its owner alone

A token reads t6gps_ID_SECRET. The identifier finds its line, the secret has 256 random bits and is nowhere kept.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import re
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pydantic import BaseModel, ValidationError

from t6gps.service.remote.messages import IssuedToken, TokenLine, TokenRequest
from t6gps.storage import durable
from t6gps.storage.errors import ServerError

FOLDER = ".server"
_TEXT = re.compile(r"t6gps_([0-9a-f]{16})_([A-Za-z0-9_-]{43})", re.ASCII)
_NOBODY = hashlib.sha256(b"").hexdigest()
_OTHERS = 0o077


class RefusedTokenError(ServerError):
    """A token that opens nothing."""


class Token(TokenLine):
    """A line of the file."""

    id: str
    sha256: str


class _Book(BaseModel):
    tokens: list[Token] = []


def folder(root: Path) -> Path:
    """The server's own folder below a root, made when missing, its owner's alone."""
    path = root / FOLDER
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise ServerError(f"cannot make {path}: {error.strerror}; give a root that you may write") from None
    return path


def issue(root: Path, request: TokenRequest, now: datetime) -> IssuedToken:
    """A new token. ServerError where another one that has not expired has the name."""
    identity, secret = secrets.token_hex(8), secrets.token_urlsafe(32)
    text = f"t6gps_{identity}_{secret}"
    line = TokenLine(name=request.name, scope=request.scope, created=now, expires=now + timedelta(days=request.days))
    with _written(root) as book:
        others = [token for token in book.tokens if token.expires > now]
        if any(token.name == request.name for token in others):
            raise ServerError(f"there is a token {request.name!r} already; revoke it, or choose another name")
        book.tokens = [*others, Token(**line.model_dump(), id=identity, sha256=_digest(secret))]
    return IssuedToken(**line.model_dump(), token=text)


def listed(root: Path) -> list[TokenLine]:
    """All tokens by name, expired ones included."""
    lines = [TokenLine(**token.model_dump(include=set(TokenLine.model_fields))) for token in _read(root).tokens]
    return sorted(lines, key=lambda line: line.name)


def revoke(root: Path, name: str) -> None:
    """Forget a token; whoever holds it is refused from now on. ServerError naming those that there are."""
    with _written(root) as book:
        others = [token for token in book.tokens if token.name != name]
        if len(others) == len(book.tokens):
            names = ", ".join(token.name for token in others) or "none"
            raise ServerError(f"there is no token {name!r}; tokens: {names}")
        book.tokens = others


class Verifier:
    """Checks tokens against the file, which is read again when it has changed."""

    def __init__(self, root: Path) -> None:
        self._root, self._stamp = root, (0, 0)
        self._tokens: dict[str, Token] = {}

    def verify(self, text: str, now: datetime) -> Token:
        """The token of that text. RefusedTokenError for one that is wrong, revoked or expired.

        ServerError where the tokens cannot be read.
        """
        self._refresh()
        match = _TEXT.fullmatch(text)
        identity, secret = match.groups() if match else ("", "")
        token = self._tokens.get(identity)
        known = hmac.compare_digest(token.sha256 if token else _NOBODY, _digest(secret))
        if token is None or not match or not known:
            raise RefusedTokenError("this token is not known here; ask for another one (t6gps token create)")
        if token.expires <= now:
            when = token.expires.astimezone(UTC).isoformat(timespec="seconds")
            raise RefusedTokenError(f"token {token.name!r} expired at {when}; ask for another one (t6gps token create)")
        return token

    def holds(self, token: Token, now: datetime) -> bool:
        """True while a token that was verified is neither revoked nor expired."""
        self._refresh()
        known = self._tokens.get(token.id)
        return known is not None and known.expires > now

    def _refresh(self) -> None:
        try:
            state = _path(self._root).stat()
        except FileNotFoundError:
            self._tokens, self._stamp = {}, (0, 0)
            return
        stamp = (state.st_mtime_ns, state.st_ino)
        if stamp != self._stamp:
            self._tokens = {token.id: token for token in _read(self._root).tokens}
            self._stamp = stamp


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()


def _path(root: Path) -> Path:
    return root / FOLDER / "tokens.json"


def _read(root: Path) -> _Book:
    path = _path(root)
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_mode & _OTHERS:
                raise ServerError(f"{path} may be read or written by others than its owner; run: chmod 600 {path}")
            return _Book.model_validate_json(file.read())
    except FileNotFoundError:
        return _Book()
    except OSError as error:
        raise ServerError(f"cannot read {path}: {error.strerror}; get permission to read it") from None
    except ValidationError:
        raise ServerError(f"{path} is damaged; remove it, and create the tokens anew") from None


@contextmanager
def _written(root: Path) -> Iterator[_Book]:
    """The book to change; of several processes that change it, one does at a time."""
    place = folder(root)
    with (place / "tokens.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        book = _read(root)
        yield book
        draft = durable.hidden(_path(root))
        draft.unlink(missing_ok=True)
        with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(book.model_dump_json(indent=1) + "\n")
        durable.publish(_path(root))

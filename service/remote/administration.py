"""What administrators ask of a server: its tokens, and the audit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final
from urllib.parse import quote

from t6gps.service.remote.connection import Connection, checked
from t6gps.service.remote.messages import AuditLine, IssuedToken, Scope, TokenLine, TokenRequest


@final
@dataclass(frozen=True)
class Administration:
    """Tokens and audit of a server; this needs a token with scope admin."""

    server: Connection

    def tokens(self) -> list[TokenLine]:
        """All tokens."""
        return self.server.get("/tokens", list[TokenLine])

    def create_token(self, name: str, scope: Scope, days: float) -> IssuedToken:
        """A new token."""
        return self.server.post("/tokens", IssuedToken, checked(TokenRequest, name=name, scope=scope, days=days))

    def revoke_token(self, name: str) -> None:
        """Refuse a token from now on."""
        self.server.ask("DELETE", f"/tokens/{quote(name, safe='')}")

    def audit(self) -> list[AuditLine]:
        """The newest changes that somebody asked for."""
        return self.server.get("/audit", list[AuditLine])

"""Routes about tokens and the audit."""

from __future__ import annotations

from http import HTTPStatus
from typing import Annotated

from fastapi import APIRouter, Path

from t6gps.service.remote.messages import AuditLine, IssuedToken, TokenLine, TokenName, TokenRequest
from t6gps.service.server import audit, tokens
from t6gps.service.server.guard import utc_now
from t6gps.service.server.routes.access import REFUSALS, Administering, Administration, Place

routes = APIRouter(prefix="/v1", responses=REFUSALS, tags=["admin"])


@routes.get("/tokens", dependencies=[Administering])
def listed(place: Place) -> list[TokenLine]:
    """All tokens, without what is secret of them."""
    return tokens.listed(place.root)


@routes.post("/tokens", status_code=HTTPStatus.CREATED)
def issue(operation: Administration, request: TokenRequest, place: Place) -> IssuedToken:
    """A new token; its text is told here and never again."""
    operation.update(request.model_dump(mode="json"))
    return tokens.issue(place.root, request, utc_now())


@routes.delete("/tokens/{token}", status_code=HTTPStatus.NO_CONTENT)
def revoke(
    operation: Administration, token: Annotated[TokenName, Path(description="Name of a token.")], place: Place
) -> None:
    """Refuse a token from now on."""
    tokens.revoke(place.root, token)


@routes.get("/audit", dependencies=[Administering])
def changes(place: Place) -> list[AuditLine]:
    """The newest changes, the newest last."""
    return audit.newest(place.root)

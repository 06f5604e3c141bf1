"""Streams of server-sent events: each has a slot, and lasts for as long as the token holds that asked for it.

event: refused   the token is revoked or has expired, or tokens cannot be read; data is a sentence, and the stream ends
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import AsyncGenerator, AsyncIterator
from contextlib import aclosing
from typing import final

from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from t6gps.service.remote.stream import REFUSED
from t6gps.service.server.routes.access import Served
from t6gps.service.server.tokens import Token
from t6gps.storage.errors import ServerError

CHECK_S = 0.5
"""How often it is seen to that the token holds."""
ALIVE_S = 15.0
ALIVE = ": alive\n\n"
_log = logging.getLogger(__name__)


@final
class EventStream(StreamingResponse):
    """Events for a token. HTTPException where there is no slot; it is given back however the stream ends.

    events   as texts; None, at least every CHECK_S, where there is nothing to tell
    """

    media_type = "text/event-stream"

    def __init__(self, place: Served, token: Token, events: AsyncGenerator[str | None, None]) -> None:
        super().__init__(_lasting(place, token, events), headers={"Cache-Control": "no-store"})
        self._slots = place.streams
        self._slots.take()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Send it."""
        try:
            await super().__call__(scope, receive, send)
        finally:
            self._slots.give_back()


async def _lasting(place: Served, token: Token, events: AsyncGenerator[str | None, None]) -> AsyncIterator[str]:
    yield ALIVE
    spoken_s = checked_s = time.monotonic()
    async with aclosing(events):
        async for text in events:
            if time.monotonic() - checked_s >= CHECK_S:
                reason = _refused(place, token)
                if reason is not None:
                    yield f"event: {REFUSED}\ndata: {json.dumps(reason)}\n\n"
                    return
                checked_s = time.monotonic()
            if text is not None or time.monotonic() - spoken_s > ALIVE_S:
                yield ALIVE if text is None else text
                spoken_s = time.monotonic()


def _refused(place: Served, token: Token) -> str | None:
    """Why the token opens nothing any more; None while it does."""
    try:
        holds = place.holds(token)
    except (ServerError, OSError) as error:
        _log.error("%s", error)
        return "the server cannot read its tokens; see its log"
    if holds:
        return None
    return f"token {token.name!r} is revoked or has expired; ask for another one (t6gps token create)"

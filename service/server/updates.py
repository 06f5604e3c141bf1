"""What happens to a run, as server-sent events.

event: iteration   an iteration was committed; data is its row of the table `iterations`
event: pool        something happened to its workers or episodes; data is the event, with its reason
event: status      the run's condition is another than before; data is its status. A state, so that it has no id
event: fault       the run cannot be read; data is the reason, and the stream ends

Who was cut off sends the last id as Last-Event-ID, as browsers do, and goes on after it: each comes once.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncGenerator

from t6gps.service.server.feed import LOOK_S, Cursor, Feeds, News
from t6gps.storage.catalog import Run
from t6gps.storage.errors import T6GpsError


async def stream(feeds: Feeds, run: Run, cursor: Cursor) -> AsyncGenerator[str | None, None]:
    """Events of a run after a cursor, as they come, for as long as somebody listens; None after each look."""
    condition = ""
    with feeds.of(run) as feed:
        while True:
            try:
                await feed.look(LOOK_S)
            except T6GpsError as error:
                yield _text(News("fault", str(error)))
                return
            told, condition = list(feed.after(cursor, condition)), feed.condition  # somebody slow holds up nobody
            for news in told:
                cursor = news.cursor or cursor
                yield _text(news)
            yield None
            await asyncio.sleep(LOOK_S)


def _text(news: News) -> str:
    head = f"event: {news.kind}\n" + ("" if news.cursor is None else f"id: {news.cursor}\n")
    return f"{head}data: {json.dumps(news.data)}\n\n"

"""Laws of looking at a drive: who is slow misses the oldest frames, and nothing else."""

from __future__ import annotations

import asyncio

from t6gps.service.driving.drive import WAITING_N, News, Watch


def told(watch: Watch) -> list[News | None]:
    """All that a watch has to tell, up to the end."""

    async def collected() -> list[News | None]:
        return [news async for news in watch.news(quiet_s=0.01)]

    return asyncio.run(collected())


def test_who_is_slow_misses_the_oldest_frames_and_nothing_else() -> None:
    watch = Watch()
    watch.put(News("scene", "0"))
    for number in range(3 * WAITING_N):
        watch.put(News("frame", str(number)))
    watch.put(News("steered", "{}"))
    watch.put(News("end", '"over"'))
    found = told(watch)
    frames = [news.text for news in found if news is not None and news.kind == "frame"]
    others = [news.kind for news in found if news is not None and news.kind != "frame"]
    assert others == ["scene", "steered", "end"]
    assert frames == [str(number) for number in range(3 * WAITING_N - len(frames), 3 * WAITING_N)]
    assert len(found) == WAITING_N


def test_who_looks_while_nothing_happens_is_told_so() -> None:
    async def first() -> News | None:
        return await anext(Watch().news(quiet_s=0.01))

    assert asyncio.run(first()) is None

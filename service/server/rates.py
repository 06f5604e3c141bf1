"""How often somebody may ask: a bucket of requests for each, which fills again as time goes by."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import final


@final
@dataclass
class _Bucket:
    left: float
    at_s: float


@final
class Rates:
    """Buckets by who asks. The oldest are forgotten when there are too many, and nobody's memory is unbounded."""

    def __init__(self, per_s: float, burst_n: int, most_n: int = 10_000) -> None:
        self._per_s, self._burst_n, self._most_n = per_s, burst_n, most_n
        self._buckets: dict[str, _Bucket] = {}

    def take(self, who: str, now_s: float) -> int:
        """Count a request: 0 where it may go on, else whole seconds to wait."""
        bucket = self._buckets.pop(who, None) or _Bucket(float(self._burst_n), now_s)
        bucket.left = min(float(self._burst_n), bucket.left + (now_s - bucket.at_s) * self._per_s)
        bucket.at_s = now_s
        self._buckets[who] = bucket  # last in the order
        if len(self._buckets) > self._most_n:
            del self._buckets[next(iter(self._buckets))]
        if bucket.left >= 1.0:
            bucket.left -= 1.0
            return 0
        return math.ceil((1.0 - bucket.left) / self._per_s)

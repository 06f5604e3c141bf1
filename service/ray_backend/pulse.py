"""A process that says by itself that it lives, whatever its other threads are at: a hang is told from long work.

It counts up in memory that other processes of its machine can read. A process that is stopped, or whose interpreter
stands still, does not.
"""

from __future__ import annotations

import itertools
import math
import os
import struct
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from t6gps.service.ray_backend import processes
from t6gps.service.ray_backend.processes import Process

BEAT_S, UNSEEN_S = 1.0, 5.0
"""Between two signs of life; whoever has not looked for so long begins to count anew."""
_BEATS = struct.Struct("Q")


@dataclass(frozen=True)
class Pulse:
    """A process of some machine; `beats` is the descriptor, in that process, of the memory with their number."""

    process: Process
    beats: int


def start() -> Pulse:
    """Let this process count up every second as long as it lives."""
    pulse = Pulse(processes.dump_stacks_on_signal(), os.memfd_create("pulse"))
    threading.Thread(target=_beat, args=(pulse.beats,), name="pulse", daemon=True).start()
    return pulse


class Watch:
    """Somebody who looks at a process of this machine again and again."""

    def __init__(self, pulse: Pulse) -> None:
        self.pulse = pulse
        self._beats, self._since_s, self._looked_s = b"", time.monotonic(), -math.inf

    def silent_s(self) -> float:
        """How long it has given no sign of life while somebody looked (s); 0 when it has ended."""
        now = time.monotonic()
        try:
            beats = Path(f"/proc/{self.pulse.process.pid}/fd/{self.pulse.beats}").read_bytes()
        except (FileNotFoundError, ProcessLookupError):
            return 0.0
        if beats != self._beats or now - self._looked_s > UNSEEN_S:
            self._beats, self._since_s = beats, now
        self._looked_s = now
        return now - self._since_s


def _beat(descriptor: int) -> None:
    for beat in itertools.count():
        os.pwrite(descriptor, _BEATS.pack(beat), 0)
        time.sleep(BEAT_S)

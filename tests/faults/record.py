"""Records what a supervisor observes and decides under faults: `python tests/faults/record.py OUT.jsonl`.

tests/service/pool/recorded_failure.jsonl was made so: two workers on Ray, of which one is killed, one hangs and one
fails in C, and an episode that always raises. Run it again when the supervisor decides otherwise on purpose.
"""

from __future__ import annotations

import os
import re
import signal
import sys
import tempfile
from contextlib import closing
from pathlib import Path

from house import House, pid

from t6gps.storage import catalog
from t6gps.storage.records import Episode

CONFIG = {"run": {"episodes": 16, "steps": 5, "workers": 2, "cpus_per_worker": 0.5}}
FOLDERS = re.compile(r"(?:/[\w.+-]+)+/(?=[\w.+-]+\.py)")
"""Of the files in tracebacks, which nobody else has."""


def main(out: Path) -> None:
    with tempfile.TemporaryDirectory() as root:
        house = House(Path(root), CONFIG)
        with catalog.locked(house.run), closing(house.executor):
            while not house.ready(2):
                pass
            house.sample()
            for episode, fault in ((5, "hang-in-python 1"), (9, "raise"), (12, "fault 1")):
                house.order(episode, fault)

            def kill(found: list[Episode]) -> None:
                if len(found) == 4:
                    os.kill(pid(house.workers[0]), signal.SIGKILL)

            house.sample(kill)
        out.write_text(FOLDERS.sub("", (house.run.pool / "decisions.jsonl").read_text()))


if __name__ == "__main__":
    main(Path(sys.argv[1]))

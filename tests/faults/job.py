"""A run of stub workers in a process of its own: `python job.py ROOT` samples one batch after another into its spool.

It begins with one worker and gets one on every host that joins (autoscaling), tells its status like any run, and ends
after the batch in which ROOT/enough appears.
"""

from __future__ import annotations

import sys
from contextlib import closing
from itertools import count
from pathlib import Path

from house import House, policy

from t6gps.service import seeding
from t6gps.service.pool.state import RunState
from t6gps.storage import catalog
from t6gps.storage.spool import Spool

CONFIG = {"run": {"episodes": 60, "steps": 250, "workers": 1, "workers_min": 1, "workers_max": 3}}


def main(root: Path) -> None:
    house = House(root, CONFIG)
    with catalog.locked(house.run), closing(house.executor) as executor:
        for iteration in count():
            spool = Spool(house.run.spool, iteration)
            executor.sample(seeding.training_plans(house.config, iteration), policy(iteration), spool.append)
            if (root / "enough").exists():
                break
        executor.close(RunState.DONE)


if __name__ == "__main__":
    main(Path(sys.argv[1]))

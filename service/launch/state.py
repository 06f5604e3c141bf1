"""Where the user's records of jobs lie; with nothing slow to import, since shells ask for it at each TAB."""

from __future__ import annotations

import os
from pathlib import Path


def folder() -> Path:
    """The user's folder of jobs, whether it is there or not."""
    state = os.environ.get("T6GPS_STATE")
    base = Path(state) if state else Path(os.environ.get("XDG_STATE_HOME") or "~/.local/state").expanduser() / "t6gps"
    return base / "jobs"

"""Files of recordings: one an episode, each whole or not at all; and the viewer that opens them."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from t6gps.storage import durable
from t6gps.storage.errors import ConfigError

SUFFIX = ".rrd"
DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")
"""One of these variables says where windows open."""

VIEWER = (sys.executable, "-P", "-c", "import sys; from rerun_cli.__main__ import main; sys.exit(main())")
"""Rerun's program; as a module, it would end with 0 whatever happens."""

OPTIONS = ("--new", "--bind", "127.0.0.1")
"""A viewer of its own, which listens to this machine alone."""


def planned(out: Path, names: Sequence[str]) -> list[Path]:
    """Where recordings of such names are written: to the file `out`, or to the folder, which is made.

    ConfigError for several recordings in one file, another suffix, or a folder that cannot be.
    """
    if out.suffix == SUFFIX and not out.is_dir():
        if len(names) > 1:
            raise ConfigError(f"{out} holds one episode, found {len(names)}; name a folder with --out, or one episode")
        found = [out]
    elif out.suffix and not out.is_dir():
        raise ConfigError(f"cannot write {out}: found the suffix '{out.suffix}'; allowed: {SUFFIX}, or a folder")
    elif out.is_file():
        raise ConfigError(
            f"cannot write to {out}: it is a file, found where a folder is wanted; choose another, or FILE{SUFFIX}"
        )
    else:
        found = [out / f"{name}{SUFFIX}" for name in names]
    if not out.parent.is_dir():
        raise ConfigError(f"cannot write {out}: there is no folder {out.parent}; create it, or choose another")
    return found


def write(file: Path, content: bytes) -> None:
    """Write a recording, whole or not at all. ConfigError where that cannot be."""
    try:
        file.parent.mkdir(exist_ok=True)
        durable.replace(file, content)
    except OSError as error:
        raise ConfigError(
            f"cannot write {file}: {error.strerror or error}; choose a folder you may write to"
        ) from error


def check_display() -> None:
    """ConfigError where no window can open."""
    if sys.platform == "linux" and not any(os.environ.get(name) for name in DISPLAYS):
        raise ConfigError(
            f"this machine has no display for the viewer: neither {DISPLAYS[0]} nor {DISPLAYS[1]} is set; write a file "
            f"with --out episode{SUFFIX}, and open it where there is one with: rerun episode{SUFFIX}"
        )


def show(recordings: Sequence[Path]) -> None:
    """Open recordings in the viewer until it is closed. ConfigError where it fails."""
    code = subprocess.run([*VIEWER, *OPTIONS, *recordings], check=False).returncode
    if code:
        raise ConfigError(
            f"the viewer has failed with exit code {code}, see above; write a file with --out episode{SUFFIX}, and "
            f"open it on another machine with: rerun episode{SUFFIX}"
        )

"""What helps against an error of the operating system, by its number."""

from __future__ import annotations

import errno
import os
from pathlib import Path

FULL = "the disk is full: remove what is not needed there, or choose another folder"
REMEDIES = {
    errno.ENOSPC: FULL,
    errno.EDQUOT: "your quota is used up: remove what is not needed there, or choose another folder",
    errno.EFBIG: "a limit holds for the size of files: raise it (ulimit -f unlimited)",
    errno.EROFS: "the file system is read-only: choose another folder, or mount it writable",
    errno.EACCES: "permission is missing: choose another folder, or give your user access to this one",
    errno.EPERM: "permission is missing: choose another folder, or give your user access to this one",
    errno.EMFILE: "this process may open no more files: raise the limit (ulimit -n 4096)",
    errno.ENFILE: "the machine has no more open files to give: end other programs, or raise fs.file-max",
    errno.ENOENT: "correct the path",
    errno.ENOTDIR: "a part of the path is a file: correct the path",
    errno.EISDIR: "a folder stands where a file is needed: correct the path",
    errno.EIO: "the device does not read or write: look at its cable, its network, and the kernel's log (dmesg)",
    errno.ENOMEM: "memory ran out: end other programs, or ask for fewer --workers",
    errno.EAGAIN: "no further process could be started: raise the limit (ulimit -u), or ask for fewer --workers",
    errno.ENAMETOOLONG: "choose a shorter name",
}


def remedy(number: int | None) -> str:
    """What to do, empty where nothing is known."""
    return "" if number is None else REMEDIES.get(number, "")


def sentence(error: OSError, folder: Path | None = None) -> str:
    """Where, what, and what to do; `folder` is where the program was at work if the error does not say."""
    where = error.filename if error.filename is not None else folder
    if isinstance(where, bytes):
        where = os.fsdecode(where)
    parts = [error.strerror or str(error), remedy(error.errno)]
    return ("" if where is None else f"{where}: ") + "; ".join(part for part in parts if part)

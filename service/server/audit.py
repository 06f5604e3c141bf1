"""A line for each change that somebody asked for, whether it was made or refused.

ROOT/.server/audit.jsonl   newest last; a file that has grown large becomes audit.1.jsonl
"""

from __future__ import annotations

import os
from collections import deque
from pathlib import Path

from t6gps.service.remote.messages import AuditLine
from t6gps.service.server.tokens import folder

LARGEST_BYTES = 16 * 2**20
SHOWN_N = 1000


def prepare(root: Path) -> None:
    """See that a line can be written, before anything is changed. OSError where it cannot."""
    path = _path(root)
    if path.exists() and path.stat().st_size > LARGEST_BYTES:
        path.replace(path.with_name("audit.1.jsonl"))
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600))


def write(root: Path, line: AuditLine) -> None:
    """Add a line."""
    with _path(root).open("a", encoding="utf-8") as file:
        file.write(line.model_dump_json() + "\n")


def newest(root: Path) -> list[AuditLine]:
    """The newest lines, the newest last."""
    path = _path(root)
    if not path.exists():
        return []
    with path.open("rb") as file:
        return [AuditLine.model_validate_json(text) for text in deque(file, SHOWN_N)]


def _path(root: Path) -> Path:
    return folder(root) / "audit.jsonl"

"""The smallest run that learns, and who watches runs in tests."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import command
import run_digest

from t6gps.service.config import Config, load
from t6gps.storage import catalog
from t6gps.storage.catalog import Run

TINY = (
    "run.iterations=3",
    "run.episodes=3",
    "run.steps=30",
    "run.evaluation_episodes=2",
    "learner.smallest_class_segments=4",
    "learner.epochs=2",
    "learner.replay_iterations=1",
    "learner.hidden_layers=[16]",
    "learner.value_from=100",  # it takes longer than all else, in runs that tests make longer
)
"""Its settings, beside those of flat-quick."""
VALUED = (
    "--set=learner.value_from=2",
    "--set=learner.action_value.first_steps=20",
    "--set=learner.action_value.steps=10",
)
"""Options of a run that an action value leads all the same, from the third iteration on."""


@dataclass
class Watcher:
    """Watches a run: keeps what it is told, and never stops it."""

    phases: set[str] = field(default_factory=set)
    rows: list[dict[str, Any]] = field(default_factory=list)

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        assert 0 <= done <= total
        self.phases.add(phase)

    def finished(self, row: dict[str, Any]) -> None:
        self.rows.append(row)


@dataclass(frozen=True)
class Trained:
    """A finished run that tests read and leave as it is, and what `t6gps train` printed of it."""

    run: Run
    config: Config
    printed: str
    digests: dict[str, str]


def settings() -> list[str]:
    """TINY as options of the command line."""
    return [f"--set={setting}" for setting in TINY]


def train(root: Path) -> Trained:
    """Train a run `tiny` in a folder, by the command line and in this process."""
    done = command.t6gps("train", "flat-quick", "--run", "tiny", "--serial", "--root", root, *settings())
    run = catalog.open_run(root, "tiny")
    return Trained(run, load("flat-quick", TINY), done.stdout.decode(), run_digest.digests(run.path))

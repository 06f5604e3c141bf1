"""Laws of publishing a study: each run is copied whole, what was cut off is continued, and nothing starts in vain."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import obstore
import pytest
from run_digest import digests

from t6gps.service.steering import published
from t6gps.service.studies import conduct
from t6gps.service.studies.declared import Arm, Baseline, Scale, Study
from t6gps.service.training import verification
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError, StoreError
from t6gps.storage.objects import place
from t6gps.storage.objects.place import ObjectPath

pytestmark = pytest.mark.slow
STUDY = Study(
    question="Does learning help?",
    arms={
        "learned": Arm("learned", "flat", "flat-quick"),
        "flop": Arm("flop", "flat", "flat-quick", baseline=Baseline.FLOP),
    },
    quick=(
        *("run.iterations=1", "run.episodes=4", "run.steps=40", "run.evaluation_episodes=2"),
        *("learner.smallest_class_segments=4", "learner.epochs=1", "learner.hidden_layers=[8]"),
    ),
    quick_seeds=1,
    conditions={"tilted": ("terrain.tilt_deg=20",)},
)
NAMES = ("pair-quick-learned-0", "pair-quick-flop-0")


class Watcher:
    """Watches a study, and interrupts it when a run has been trained, as often as asked."""

    def __init__(self, stops_n: int = 0) -> None:
        self.titles: list[str] = []
        self._stops_n = stops_n

    def say(self, sentence: str) -> None:
        assert sentence

    def warn(self, sentence: str) -> None:
        raise AssertionError(sentence)

    def run(self, iterations: int) -> AbstractContextManager[Watcher]:
        return nullcontext(self)

    def task(self, title: str) -> AbstractContextManager[Callable[[int, int], None]]:
        self.titles.append(title)
        return nullcontext(lambda done, total: None)

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        if phase == "evaluate" and self._stops_n:
            self._stops_n -= 1
            raise KeyboardInterrupt

    def finished(self, row: dict[str, Any]) -> None: ...


def conducted(root: Path, copies: ObjectPath, watcher: Watcher) -> None:
    planned = conduct.trials("pair", STUDY, Scale.QUICK)
    conduct.conduct(planned, root, "pair", STUDY.conditions, True, watcher, copies=copies)


def test_a_study_that_was_interrupted_is_published_whole(tmp_path: Path, objects: ObjectPath) -> None:
    with pytest.raises(KeyboardInterrupt):
        conducted(tmp_path, objects, Watcher(stops_n=1))
    watcher = Watcher()
    conducted(tmp_path, objects, watcher)
    assert [title for title in watcher.titles if title.startswith("publishing ")] == [
        f"publishing {name}" for name in (*NAMES, *NAMES)
    ]
    for name in NAMES:
        here, there = catalog.open_run(tmp_path, name), Run(objects / name)
        assert verification.verify(there) == []
        assert digests(there.path) == digests(here.path)
        own = {"pool", "figures", "spool"}
        kept = {file: size for file, size in place.below(here.path).items() if Path(file).parts[0] not in own}
        assert {file for file in kept if not any(part.startswith(".") for part in Path(file).parts)} == set(
            place.below(there.path)
        )
        assert {"study.json", "evaluation.json", "conditions/tilted.json"} <= set(place.below(there.path))
        assert (published.standing(here) or {}).get("behind") == 0


def test_a_study_that_cannot_be_published_begins_no_run(
    tmp_path: Path, objects: ObjectPath, monkeypatch: pytest.MonkeyPatch
) -> None:
    obstore.put(objects.client(), (objects / NAMES[1] / "config.json").key, b"of another")
    with pytest.raises(RunError, match=f"{NAMES[1]} holds another run of that name"):
        conducted(tmp_path, objects, Watcher())
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(StoreError, match="does not answer"):
        conducted(tmp_path, objects, Watcher())
    assert catalog.list_runs(tmp_path) == []

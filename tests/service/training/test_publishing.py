"""Laws of publishing a run while it is trained: trouble never stops it, nothing is lost, and it goes on elsewhere."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import object_stores
import pytest
from command import t6gps
from run_digest import digests
from tiny_run import TINY, Trained, Watcher, settings

from t6gps.service.config import load
from t6gps.service.steering import published
from t6gps.service.training import origin, session, verification
from t6gps.storage import catalog, tables
from t6gps.storage.catalog import Run
from t6gps.storage.objects import publishing
from t6gps.storage.objects.place import ObjectPath

WAIT_S = 240.0
pytestmark = pytest.mark.slow
Wait = Callable[..., None]


class Acts(Watcher):
    """Does something when an iteration is committed."""

    def __init__(self, act: Callable[[int], None]) -> None:
        super().__init__()
        self._act = act

    def finished(self, row: dict[str, Any]) -> None:
        super().finished(row)
        self._act(row["iteration"])


def made(root: Path) -> Run:
    return origin.create(load("flat-quick", TINY), root, "tiny")


def test_a_store_that_is_killed_and_comes_back_gets_everything(
    tiny: Trained, objects: ObjectPath, seaweed: object_stores.Store, tmp_path: Path, wait_until: Wait
) -> None:
    run = made(tmp_path)

    def act(iteration: int) -> None:
        if iteration == 0:
            wait_until(lambda: (published.standing(run) or {}).get("iterations") == 1, WAIT_S)
            seaweed.kill()
        if iteration == 1:
            wait_until(lambda: (published.standing(run) or {}).get("error") is not None, WAIT_S)
            told = published.standing(run)
            assert told is not None
            assert (told["iterations"], told["behind"]) == (1, 1)
            assert "does not answer" in str(told["error"])
            seaweed.start()

    session.complete(tiny.config, run, True, Acts(act), objects)
    assert digests(run.path) == tiny.digests == digests(objects / "tiny")
    assert verification.verify(Run(objects / "tiny")) == []
    assert published.standing(run) == {"to": str(objects / "tiny"), "iterations": 3, "behind": 0, "error": None}


def test_a_run_that_ended_early_goes_on_elsewhere_to_the_same_bytes(
    tiny: Trained,
    objects: ObjectPath,
    tmp_path: Path,
    wait_until: Wait,
    caplog: pytest.LogCaptureFixture,
) -> None:
    run = made(tmp_path / "here")

    def act(iteration: int) -> None:
        wait_until(lambda: (published.standing(run) or {}).get("iterations") == iteration + 1, WAIT_S)
        if iteration == 1:
            raise KeyboardInterrupt

    with caplog.at_level(logging.WARNING), pytest.raises(KeyboardInterrupt):
        session.complete(tiny.config, run, True, Acts(act), objects)
    assert "run tiny is published as far as 2 of 2 iterations" in caplog.text
    assert f"finish with: t6gps cp tiny tiny --root {run.path.parent} --to {objects}" in caplog.text
    t6gps("cp", "tiny", "tiny", "--root", objects, "--to", tmp_path / "there")
    there = catalog.open_run(tmp_path / "there", "tiny")
    t6gps(
        *("train", "flat-quick", "--serial", "--resume", "--run", "tiny", "--root", tmp_path / "there"),
        *("--publish", objects, *settings()),
    )
    assert digests(there.path) == tiny.digests == digests(objects / "tiny")
    assert verification.verify(Run(objects / "tiny")) == []
    refused = t6gps("cp", "tiny", "tiny", "--root", run.path.parent, "--to", objects, code=2)
    assert "has more of the run" in refused.stderr


def test_a_run_that_cannot_be_published_is_not_begun(tiny: Trained, objects: ObjectPath, tmp_path: Path) -> None:
    publishing.publish(tiny.run.path, objects / "tiny")
    train = ("train", "flat-quick", "--serial", "--run", "tiny", "--root", tmp_path, *settings())
    for address, sentence in (
        (str(objects), "holds another run of that name; choose another name or prefix"),
        ("s3://nowhere/runs", "there is no bucket 'nowhere'"),
        ("elsewhere", "--publish takes s3://BUCKET/PREFIX, found 'elsewhere'"),
    ):
        refused = t6gps(*train, "--publish", address, code=2)
        assert sentence in refused.stderr
        assert len(refused.stderr.splitlines()) == 1
        assert not catalog.list_runs(tmp_path)
    assert tables.committed_iterations(Run(objects / "tiny")) == 3


def test_a_run_resumes_where_its_store_is_away(
    tiny: Trained, objects: ObjectPath, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = catalog.copy(tiny.run, tmp_path, "tiny")
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    warnings = list[str]()
    resumed = session.begin(tiny.config, tmp_path, "tiny", "tiny", True, warnings.append, objects)
    assert resumed == run
    assert any("the run resumes, and is published when the store is back" in warning for warning in warnings)

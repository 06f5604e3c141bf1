"""Laws of commands on an object store: those that read answer as on a folder, those that write refuse."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import synthetic
from command import t6gps as command

import t6gps
from t6gps.service.training import study_origin as studies
from t6gps.storage.objects import publishing
from t6gps.storage.objects.place import ObjectPath

ARMS = {"study-a-0": ("a", 0), "study-a-1": ("a", 1), "study-b-0": ("b", 0)}


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The root of a study's runs, which no test changes."""
    root = tmp_path_factory.mktemp("study")
    for number, (name, (arm, seed)) in enumerate(ARMS.items(), 1):
        run = synthetic.made(root, number, name)
        with studies.recorded(run, "study", arm, seed, "0" * 7):
            pass
    return root


def test_a_published_study_is_asked_as_one_in_a_folder(study: Path, objects: ObjectPath) -> None:
    for name in ARMS:
        command("cp", name, name, "--root", study, "--to", objects)
    sql = "SELECT arm, count(DISTINCT run) AS runs, count(*) AS rows, max(speed_m_per_s) AS fastest "
    sql += "FROM frames JOIN runs USING (run) GROUP BY arm ORDER BY arm"
    for asked in (("runs",), ("verify",), ("query", "study-*", sql, "--format", "json"), ("show", "study-b-0")):
        here, there = (command(*asked, "--root", root).stdout.decode() for root in (study, objects))
        if asked[0] in ("runs", "show"):  # which say where they look
            here, there = ("".join(re.findall("^│.*", text, re.MULTILINE)) for text in (here, there))
        assert there == here != ""
        if asked[0] == "query":
            counts = [(row["arm"], row["runs"], row["rows"]) for row in json.loads(there)]
            assert counts == [("a", 2, 3 * synthetic.FRAMES_N), ("b", 1, 3 * synthetic.FRAMES_N)]


def test_a_store_of_an_object_store_is_that_of_a_folder(study: Path, objects: ObjectPath) -> None:
    for name in ARMS:
        publishing.publish(study / name, objects / name)
    here, there = t6gps.open_store(study), t6gps.open_store(str(objects))
    assert [run.name for run in there.runs()] == [run.name for run in here.runs()] == sorted(ARMS)
    sql = "SELECT run, count(*) AS rows, avg(speed_m_per_s) AS speed FROM frames GROUP BY run ORDER BY run"
    assert there.sql(sql).arrow().equals(here.sql(sql).arrow())
    number = there.run("study-a-1").sql("SELECT max(episode_id) AS last FROM episodes").numpy()["last"].item()
    assert there.run("study-a-1").episode(number).frames.equals(here.run("study-a-1").episode(number).frames)
    windows = [store.windows(["nodes"], length=2, runs="study-a-*") for store in (here, there)]
    assert len(windows[0]) == len(windows[1]) > 0
    np.testing.assert_array_equal(windows[1][0]["nodes"], windows[0][0]["nodes"])


WRITING = {
    "train": ("train", "flat-quick", "--serial"),
    "study": ("study", "horizon"),
    "eval": ("eval", "rolling", "--serial"),
    "repair": ("repair", "rolling"),
    "mv": ("mv", "rolling", "other"),
    "rm": ("rm", "rolling", "--yes"),
    "submit": ("submit", "flat-quick"),
    "serve": ("serve", "--port", "0"),
    "cp": ("cp", "rolling", "other"),
}


def test_commands_that_write_refuse_an_object_store(tmp_path: Path, objects: ObjectPath) -> None:
    run = synthetic.made(tmp_path, 1)
    publishing.publish(run.path, objects / run.name)
    before = objects.below()
    for writing in WRITING.values():
        refused = command(*writing, "--root", objects, code=2)
        errors = [line for line in refused.stderr.splitlines() if not line.startswith("warning:")]
        assert len(errors) == 1, errors
        assert "in an object store" in errors[0]
    assert objects.below() == before

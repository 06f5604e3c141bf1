"""Every question of docs/queries.md is asked of a root of three runs, and is answered as it says."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pyarrow as pa
import pytest
from tiny_run import Trained

from t6gps.service.api import asking
from t6gps.storage import catalog
from t6gps.storage.sql.query import query

PAGE = (Path(__file__).parents[2] / "docs" / "queries.md").read_text(encoding="utf-8")
QUESTIONS = dict(re.findall(r"^### (.*?)\n.*?^```sql\n(.*?)^```", PAGE, re.M | re.S))
VALUES = {"least": 0.0, "seed": 3, "run": "walk-0", "episode": 1, "one": "walk-0", "other": "slide"}
MAY_BE_EMPTY = {
    "Which settings differ among the runs?": False,
    "After how many steps is a run faster than a given speed?": True,
    "In which iterations did the cost rise?": True,
    "Where does it get stuck, by slope?": True,
    "Where does it get stuck, by place?": True,
    "Which triangle was entered last before it got stuck?": True,
}
"""Questions whose answer hangs on how the robot moves."""


def refuse(warning: str) -> None:
    raise AssertionError(warning)


@pytest.fixture(scope="module")
def root(tiny: Trained, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two seeds of one arm, as a study has them, and a run beside them with another friction."""
    root = tmp_path_factory.mktemp("questions")
    for seed in range(2):
        run = catalog.copy(tiny.run, root, f"walk-{seed}")
        study = {"study": "walks", "arm": "walk", "seed": seed, "commits": ["a"], "wall_s": 1.0, "cores": 2}
        (run.path / "study.json").write_text(json.dumps(study))
    other = catalog.copy(tiny.run, root, "slide")
    settings = json.loads(other.config_path.read_text())
    settings["robot"]["friction"] = 0.7
    other.config_path.write_text(json.dumps(settings))
    return root


def asked(root: Path, sql: str) -> pa.Table:
    named = {name: value for name, value in VALUES.items() if f"${name}" in sql}
    return query(asking.question(root, "*", sql, named, refuse))


def test_the_page_has_as_many_questions_as_it_says() -> None:
    assert len(QUESTIONS) == 30
    assert PAGE.startswith("# Thirty questions\n")


@pytest.mark.parametrize("question", QUESTIONS)
def test_a_question_of_the_page_is_answered(question: str, root: Path) -> None:
    found = asked(root, QUESTIONS[question])
    assert found.num_rows or MAY_BE_EMPTY.get(question, False)
    assert not any(re.search(r"[ ()*]|_1$", name) for name in found.column_names), "each column has a name"


def test_answers_are_those_that_copies_of_a_run_must_give(root: Path) -> None:
    differing = asked(root, QUESTIONS["Which settings differ among the runs?"]).to_pylist()
    assert differing == [{"name": "robot_friction", "found": ["0.7", "1.0"]}]
    pairs = asked(root, QUESTIONS["Is one run's policy better than another's on the same seeds?"]).to_pylist()
    assert pairs == [{"pairs": 2, "difference": 0.0, "standard_error": 0.0, "t": None}]
    seeds = asked(root, QUESTIONS["How do seeds of the same arm compare?"]).to_pylist()
    assert {row["arm"]: row["seeds"] for row in seeds} == {"walk": 2, None: 1}
    lines = asked(root, QUESTIONS["From which policy does a policy come, back to the untrained one?"])
    assert lines.column("version").to_pylist() == 3 * [3, 2, 1, 0]

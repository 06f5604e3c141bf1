"""Laws of rendered tables: measured figures stand once, in docs/figures, states in the code, and pages repeat them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

NAMES = sorted(file.stem for file in (Path(__file__).parents[2] / "docs" / "figures").glob("*.json"))
COMMITS = re.compile(r"[0-9a-f]{7}(, [0-9a-f]{7})*")
QUOTED = re.compile(r"(?<![\d.])\d+\.\d{3}(?!\d)")


def test_every_page_says_what_the_measurements_say(render: ModuleType) -> None:
    stale = [str(page) for page in render.pages() if page.read_text(encoding="utf-8") != render.rendered(page)]
    assert not stale, "render them anew: make docs"


def test_every_measurement_stands_on_a_page(render: ModuleType) -> None:
    shown = {mark[1] for page in render.pages() for mark in render.MARKED.finditer(page.read_text(encoding="utf-8"))}
    assert shown == set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_measurement_says_how_when_and_where_it_was_made(name: str, render: ModuleType) -> None:
    measurement = render.load(name)
    assert set(measurement) <= {*render.PROVENANCE, "notes", "columns", "rows"}
    assert measurement["commit"] is None or COMMITS.fullmatch(measurement["commit"])
    assert measurement["date"] is None or re.fullmatch(r"20\d\d-[01]\d-[0-3]\d", measurement["date"])
    assert all(len(row) == len(measurement["columns"]) for row in measurement["rows"])


@pytest.mark.parametrize("page", ["README.md", "docs/results.md"])
def test_every_speed_and_share_that_a_summary_quotes_was_measured(
    page: str, pages: dict[str, str], repository: Path, render: ModuleType
) -> None:
    measured = set(QUOTED.findall("\n".join(render.table(name, repository / page) for name in NAMES)))
    assert set(QUOTED.findall(pages[page])) <= measured


@pytest.mark.parametrize("key", ["command", "commit", "machine", "date", "columns", "rows"])
def test_a_measurement_of_unknown_origin_is_refused(key: str, render: ModuleType, tmp_path: Path) -> None:
    whole: dict[str, Any] = {"command": None, "commit": None, "machine": None, "date": None, "columns": [], "rows": []}
    (tmp_path / "speed.json").write_text(json.dumps({name: value for name, value in whole.items() if name != key}))
    with pytest.raises(render.FiguresError, match=rf"speed\.json lacks {key}"):
        render.load("speed", tmp_path)


def test_a_marker_without_a_measurement_is_refused(render: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text("<!-- figures: nowhere -->\n<!-- end -->\n")
    with pytest.raises(render.FiguresError, match="no figures 'nowhere'; allowed: "):
        render.rendered(page)


@pytest.mark.parametrize("marker", ["figures: rough", "states: run", "metrics", "alerts"])
def test_a_marker_without_an_end_is_refused(marker: str, render: ModuleType, tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"<!-- {marker} -->\n")
    with pytest.raises(render.FiguresError, match="no end"):
        render.rendered(page)


def test_every_state_stands_on_a_page_with_what_may_follow_it(render: ModuleType) -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in render.pages())
    assert {mark[1] for mark in render.MARKED_STATES.finditer(text)} == set(render.STATES)
    for name, (kind, following) in render.STATES.items():
        rows = [row.split(" | ") for row in render.states(name).splitlines()[2:]]
        assert [row[0].strip("| `") for row in rows] == list(kind)
        if following is not None:
            named = [set(re.findall(r"`(\w+)`", row[2])) for row in rows]
            assert named == [{str(state) for state in following[member]} for member in kind]


def test_every_metric_and_every_alert_stands_on_a_page(render: ModuleType) -> None:
    text = "\n".join(page.read_text(encoding="utf-8") for page in render.pages())
    assert sorted(mark[1] for mark in render.MARKED_LISTS.finditer(text)) == ["alerts", "metrics"]
    assert all(f"| `{metric.name}` |" in text for metric in render.METRICS)
    names = re.findall(r"- alert: (\w+)", render.ALERTS.read_text(encoding="utf-8"))
    assert names
    assert all(f"| `{name}` |" in text for name in names)


def test_the_meaning_of_a_state_is_its_docstring(render: ModuleType) -> None:
    kind, _ = render.STATES["failure"]
    assert render.meanings(kind)["HANG"] == "No result before the deadline"


def test_states_that_do_not_exist_are_refused(render: ModuleType) -> None:
    with pytest.raises(render.FiguresError, match="no states 'weather'; allowed: worker, run"):
        render.states("weather")


def test_cells_show_every_digit_that_was_measured(render: ModuleType) -> None:
    assert render.cell({"mean": 0.6, "sd": 0.02}, 3, "m/s") == "0.600 +- 0.020 m/s"
    assert render.cell([0.45, None], 3) == "0.450, (not run)"
    assert render.cell(375000) == "375,000"


def test_what_was_not_measured_is_an_empty_cell(render: ModuleType) -> None:
    assert render.cell(None, 3, "%") == ""

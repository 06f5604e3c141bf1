"""Renders tables into README.md and the pages of docs: measured figures, states of workers and runs, metrics, alerts.

A page says where a table goes; what stands between the two markers is replaced:

    <!-- figures: NAME -->      the measurement docs/figures/NAME.json
    <!-- end -->

    <!-- states: NAME -->       one of STATES, as the code has it: each member, its docstring, and what may follow
    <!-- end -->

    <!-- metrics -->            the metrics of /metrics; <!-- alerts --> the rules of deploy/prometheus/alerts.yml
    <!-- end -->

A file in docs/figures is one measurement:

    command   what was run, several joined by &&; null for code that is no part of this package
    commit    the commit that was measured, several joined by commas
    machine   what it ran on
    date      day of that commit
    notes     what else one must know to read or repeat it (may be absent)
    columns   {"name", "digits", "unit"} each: digits after the point, and what follows each number (both may be absent)
    rows      cells: text, a number, {"mean", "sd"}, a list of numbers (one per seed), or null for what was not measured

Run as a program (`make docs`), it writes the pages anew, and the commands as the completion of shells reads them.
"""

from __future__ import annotations

import ast
import inspect
import json
import os
import re
import textwrap
from collections.abc import Mapping
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Any

import yaml

from t6gps.service.cli.guide import completion, described
from t6gps.service.cli.main import app
from t6gps.service.monitoring.metrics import METRICS
from t6gps.service.pool.attempt import FailureKind
from t6gps.service.pool.state import NEXT_PHASES, NEXT_STATES, Ending, RunState, WorkerPhase
from t6gps.service.steering.events import EventKind

REPOSITORY = Path(__file__).parents[1]
FIGURES = REPOSITORY / "docs" / "figures"
ALERTS = REPOSITORY / "deploy" / "prometheus" / "alerts.yml"
MARKED = re.compile(r"<!-- figures: (\S+) -->\n(.*?)<!-- end -->", re.DOTALL)
MARKED_LISTS = re.compile(r"<!-- (metrics|alerts) -->\n(.*?)<!-- end -->", re.DOTALL)
MARKED_STATES = re.compile(r"<!-- states: (\S+) -->\n(.*?)<!-- end -->", re.DOTALL)
STATES: dict[str, tuple[type[StrEnum], Mapping[Any, set[Any]] | None]] = {
    "worker": (WorkerPhase, NEXT_PHASES),
    "run": (RunState, NEXT_STATES),
    "failure": (FailureKind, None),
    "ending": (Ending, None),
    "event": (EventKind, None),
}
"""Enums by the name of their marker, with what may follow each member where that is limited."""
PROVENANCE = ("command", "commit", "machine", "date")
LINE_WIDTH = 120


class FiguresError(Exception):
    """A measurement that is missing or incomplete, states that do not exist, or a marker that is never closed."""


def pages() -> list[Path]:
    """Every page that may hold measured figures."""
    return [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]


def load(name: str, folder: Path = FIGURES) -> dict[str, Any]:
    """The measurement of that name. FiguresError where there is none or its origin is not stated."""
    file = folder / f"{name}.json"
    if not file.is_file():
        known = ", ".join(sorted(path.stem for path in folder.glob("*.json")))
        raise FiguresError(f"no figures '{name}'; allowed: {known}; add docs/figures/{name}.json or mend the marker")
    measurement: dict[str, Any] = json.loads(file.read_text(encoding="utf-8"))
    missing = [key for key in (*PROVENANCE, "columns", "rows") if key not in measurement]
    if missing:
        raise FiguresError(f"docs/figures/{name}.json lacks {', '.join(missing)}; write null for what is unknown")
    return measurement


def cell(value: Any, digits: int = 0, unit: str = "") -> str:
    """One cell of a table as text, empty for null: numbers with `digits` after the point and `unit` behind them."""
    if value is None:
        return ""
    if isinstance(value, str):
        return value
    if isinstance(value, dict):
        number = f"{value['mean']:,.{digits}f} +- {value['sd']:,.{digits}f}"
    elif isinstance(value, list):
        number = ", ".join("(not run)" if item is None else f"{item:,.{digits}f}" for item in value)
    else:
        number = f"{value:,.{digits}f}"
    return f"{number} {unit}".rstrip()


def table(name: str, page: Path) -> str:
    """The table of a measurement in Markdown, and below it the command, machine and day, with a link to the file."""
    measurement = load(name)
    columns = measurement["columns"]
    lines = ["| " + " | ".join(column["name"] for column in columns) + " |", "|---" * len(columns) + "|"]
    for row in measurement["rows"]:
        if len(row) != len(columns):
            raise FiguresError(f"docs/figures/{name}.json: row {row[0]!r} has {len(row)} cells, not {len(columns)}")
        cells = (
            cell(value, column.get("digits", 0), column.get("unit", ""))
            for value, column in zip(row, columns, strict=True)
        )
        lines.append("| " + " | ".join(cells) + " |")
    link = os.path.relpath(FIGURES / f"{name}.json", page.parent)
    command = f"`{measurement['command']}`" if measurement["command"] else None
    origin = ", ".join(filter(None, (command, measurement["machine"], measurement["date"])))
    source = textwrap.fill(f"*{origin} ([data]({link})).*", LINE_WIDTH, break_long_words=False, break_on_hyphens=False)
    return "\n".join([*lines, "", source])


def meanings(kind: type[StrEnum]) -> dict[str, str]:
    """The docstring of each member of an enum by the member's name, without its last full stop."""
    definition = ast.parse(inspect.getsource(kind)).body[0]
    assert isinstance(definition, ast.ClassDef), "an enum is a class"
    texts = {}
    for member, text in pairwise(definition.body):
        match member, text:
            case ast.Assign(targets=[ast.Name(id=name)]), ast.Expr(value=ast.Constant(value=str(words))):
                texts[name] = " ".join(words.split()).rstrip(".")
    return texts


def states(name: str) -> str:
    """The table of one of STATES in Markdown. FiguresError where there is no such name."""
    if name not in STATES:
        raise FiguresError(f"no states '{name}'; allowed: {', '.join(STATES)}; mend the marker")
    kind, following = STATES[name]
    texts = meanings(kind)
    columns = [name, "meaning"] + ([] if following is None else ["may be followed by"])
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    for member in kind:
        cells = [f"`{member}`", texts.get(member.name, "")]
        if following is not None:
            cells.append(", ".join(f"`{other}`" for other in kind if other in following[member]) or "nothing")
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def metrics() -> str:
    """The table of the metrics in Markdown: name, type, labels with their values, and meaning."""
    lines = ["| metric | type | labels | meaning |", "|---|---|---|---|"]
    for metric in METRICS:
        labels = ", ".join(f"`{label}`" for label in metric.labels)
        values = f": {', '.join(f'`{value}`' for value in metric.values)}" if metric.values else ""
        lines.append(f"| `{metric.name}` | {metric.kind} | {labels}{values} | {metric.meaning} |")
    return "\n".join(lines)


def alerts() -> str:
    """The table of the alerts in Markdown: name, severity, what it means, and what helps."""
    lines = ["| alert | severity | what it means | what helps |", "|---|---|---|---|"]
    for group in yaml.safe_load(ALERTS.read_text(encoding="utf-8"))["groups"]:
        for rule in group["rules"]:
            said = rule["annotations"]
            cells = (f"`{rule['alert']}`", rule["labels"]["severity"], said["description"], said["remedy"])
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


LISTS = {"metrics": metrics, "alerts": alerts}


def rendered(page: Path) -> str:
    """The page's text, every marked table as measurements and code say. FiguresError for a marker without an end."""
    text = page.read_text(encoding="utf-8")
    for what, marked in (("figures", MARKED), ("states", MARKED_STATES)):
        if text.count(f"<!-- {what}: ") != len(marked.findall(text)):
            raise FiguresError(f"{page}: a marker of {what} has no end; close it with <!-- end -->")
    text = MARKED.sub(lambda mark: f"<!-- figures: {mark[1]} -->\n{table(mark[1], page)}\n<!-- end -->", text)
    if sum(text.count(f"<!-- {name} -->") for name in LISTS) != len(MARKED_LISTS.findall(text)):
        raise FiguresError(f"{page}: a marker of metrics or alerts has no end; close it with <!-- end -->")
    text = MARKED_LISTS.sub(lambda mark: f"<!-- {mark[1]} -->\n{LISTS[mark[1]]()}\n<!-- end -->", text)
    return MARKED_STATES.sub(lambda mark: f"<!-- states: {mark[1]} -->\n{states(mark[1])}\n<!-- end -->", text)


if __name__ == "__main__":
    for path in pages():
        path.write_text(rendered(path), encoding="utf-8")
    completion.FILE.write_text(described.text(app), encoding="utf-8")

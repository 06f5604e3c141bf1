"""Laws of what is shipped for Prometheus and Grafana: it asks for metrics that there are, and promtool accepts it."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from promtool import check, needs_promtool

from t6gps.service.monitoring.metrics import METRICS

DEPLOY = Path(__file__).parents[2] / "deploy"
RULES = DEPLOY / "prometheus" / "alerts.yml"
DASHBOARD = json.loads((DEPLOY / "grafana" / "t6gps.json").read_text())
ALERTS: list[dict[str, Any]] = [
    rule for group in yaml.safe_load(RULES.read_text())["groups"] for rule in group["rules"]
]
LABELS = {metric.name: {"job", "instance", *metric.labels} for metric in METRICS}
LABELS |= {name: {"job", "instance"} for name in ("up", "process_resident_memory_bytes")}
"""Of each metric that can be asked for; Prometheus itself adds job and instance."""
VARIABLES = {"$__rate_interval": "1m", "$instance": ".*", "$run": ".*"}


def queries() -> Iterator[str]:
    """The queries of the dashboard."""
    for panel in DASHBOARD["panels"]:
        for target in panel.get("targets", ()):
            yield target["expr"]
    for variable in DASHBOARD["templating"]["list"]:
        if variable["type"] == "query":
            yield re.sub(r"label_values\((.*), (\w+)\)", r"sum by (\2) (\1)", variable["query"]["query"])


def strangers(query: str) -> list[str]:
    """Metrics and labels of a query that nobody has. Its functions are promtool's business."""
    bare = re.sub(r"\b(?:by|on) \([^)]*\)", "", query)
    found: list[str] = []
    for name, matchers in re.findall(r"\b((?:t6gps|process)_\w+|up\b)(?:\{([^}]*)\})?", bare):
        asked = set(re.findall(r"(\w+)\s*=", matchers))
        found += [name] if name not in LABELS else [f"{name}: {label}" for label in sorted(asked - LABELS[name])]
    known = set().union(*LABELS.values())
    for listed in re.findall(r"\b(?:by|on) \(([^)]*)\)", query):
        found += [label for label in re.findall(r"\w+", listed) if label not in known]
    if not re.search(r"\b(?:t6gps|process)_|\bup\b", bare):
        found.append(f"no metric in {query}")
    return found


def test_every_query_asks_for_metrics_and_labels_that_there_are() -> None:
    asked = [*queries(), *(alert["expr"] for alert in ALERTS)]
    assert len(asked) > 30
    assert not [stranger for query in asked for stranger in strangers(query)]


@pytest.mark.parametrize("query", ["sum(t6gps_run)", 't6gps_run_up{name="a"}', "sum by (name) (t6gps_run_up)", "1"])
def test_a_query_for_something_else_is_seen(query: str) -> None:
    assert strangers(query)


def test_the_dashboard_shows_every_metric_but_those_that_others_imply() -> None:
    shown = " ".join(queries())
    hidden = {metric.name for metric in METRICS if not re.search(rf"\b{metric.name}\b", shown)}
    assert hidden == {"t6gps_workers_ready", "t6gps_worker_starts_total", "t6gps_control_steps_total"}


def test_values_of_labels_that_rules_and_panels_name_are_those_of_the_metrics() -> None:
    values = {value for metric in METRICS for value in metric.values}
    named = [
        value
        for query in [*queries(), *(alert["expr"] for alert in ALERTS)]
        for words in re.findall(r'\b(?:state|phase|cause)=~?"([^"]*)"', query)
        for value in words.split("|")
    ]
    assert named
    assert not set(named) - values


def test_every_alert_says_what_it_is_what_it_means_and_what_helps() -> None:
    for alert in ALERTS:
        assert {"summary", "description", "remedy"} == alert["annotations"].keys(), alert["alert"]
        assert alert["labels"]["severity"] in ("critical", "warning")


def test_panels_have_numbers_of_their_own_and_do_not_overlap() -> None:
    panels = DASHBOARD["panels"]
    assert len({panel["id"] for panel in panels}) == len(panels)
    cells = [
        (x, y)
        for place in (panel["gridPos"] for panel in panels)
        for x in range(place["x"], place["x"] + place["w"])
        for y in range(place["y"], place["y"] + place["h"])
    ]
    assert len(set(cells)) == len(cells)


@needs_promtool
def test_promtool_accepts_rules_and_configuration(tmp_path: Path) -> None:
    check("check", "rules", RULES)
    folder = shutil.copytree(RULES.parent, tmp_path / "prometheus")
    for name in ("token", "ca.pem"):  # those that the configuration names, and an operator makes
        (folder / name).touch()
    check("check", "config", folder / "prometheus.yml")


@needs_promtool
def test_promtool_accepts_every_query_of_the_dashboard(tmp_path: Path) -> None:
    rules = []
    for number, query in enumerate(queries()):
        for variable, value in VARIABLES.items():
            query = query.replace(variable, value)  # noqa: PLW2901
        rules.append({"record": f"panel:{number}", "expr": query})
    (tmp_path / "panels.yml").write_text(yaml.safe_dump({"groups": [{"name": "panels", "rules": rules}]}))
    check("check", "rules", tmp_path / "panels.yml")


@needs_promtool
def test_every_alert_fires_for_its_cause_and_for_no_other() -> None:
    check("test", "rules", Path(__file__).with_name("alerts_test.yml"))
    tested = Path(__file__).with_name("alerts_test.yml").read_text()
    assert not [alert["alert"] for alert in ALERTS if alert["alert"] not in tested]

"""Laws of `/metrics`: numbers are those of the runs, labels are bounded, and no damage of a run hides another."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from loopback import commit
from paper import House
from prometheus_client.parser import text_string_to_metric_families
from promtool import check, needs_promtool

from t6gps.service import config as configuration
from t6gps.service.monitoring.exporter import Exporter
from t6gps.service.monitoring.metrics import METRICS, Kind
from t6gps.service.steering import status
from t6gps.storage import catalog, schema
from t6gps.storage.catalog import Run
from t6gps.storage.delta import iterations
from t6gps.storage.records import Episode, Learned
from t6gps.storage.spool import Spool

Numbers = dict[tuple[str, ...], float]
ROW = {"steps": 600, "cost": 1.5, "forward_speed_m_per_s": 0.25, "stuck_share_by_distance": 0.125, "sampling_s": 2.0}
ROW |= {"segmenting_s": 0.25, "fitting_s": 0.25, "backward_pass_s": 0.25, "supervised_s": 0.25}


def create(root: Path, name: str) -> Run:
    return catalog.create(root, name, configuration.load("flat-quick").to_json())


def numbers(text: bytes) -> Numbers:
    """Values of this package's metrics by name and values of the labels, the run first."""
    return {
        (sample.name, *(sample.labels[label] for label in sorted(sample.labels, key="run".__ne__))): sample.value
        for family in text_string_to_metric_families(text.decode())
        for sample in family.samples
        if sample.name.startswith("t6gps_")
    }


def troubled() -> House:
    """A pool on paper that has sampled: an episode is in quarantine, a worker has crashed."""
    house = House(2, 12)
    house.paper.raising.add(5)
    house.paper.crashing.add(6)
    house.sample()
    return house


def tell(run: Run, house: House) -> None:
    """Let a run say how a pool on paper is, as the process that works on it."""
    run.pool.mkdir(exist_ok=True)
    status.publish(run, status.describe(house.pool.situation(), None, 8))


@pytest.fixture
def root(tmp_path: Path, make_episode: Callable[..., Episode]) -> Path:
    """A root with the run `walk`: one iteration is committed, an episode is spooled, and a bundle is kept."""
    run = create(tmp_path / "runs", "walk")
    row = dict.fromkeys(schema.ITERATIONS.names, 0) | ROW
    iterations.commit(run, 0, iter([make_episode(0, 0)]), Learned(row, [], schema.MODELS.empty_table(), []))
    Spool(run.spool, 1).append(make_episode(1, 1))
    run.bundles.mkdir()
    (run.bundles / "episode-5.json").write_text("{}")
    return run.path.parent


def test_a_run_at_work_has_every_metric_and_its_numbers_are_those_of_pool_and_tables(root: Path) -> None:
    house, run = troubled(), catalog.open_run(root, "walk")
    with catalog.locked(run):
        tell(run, house)
        found = numbers(Exporter(root).text())
    assert {metric.name for metric in METRICS} | {"t6gps_build_info"} == {name for name, *_ in found}
    state, ledger = house.pool.state, house.ledger.counters
    expected = {
        ("t6gps_run_up", "walk"): 1,
        ("t6gps_run_state", "walk", "RUNNING"): state.condition == "RUNNING",
        ("t6gps_run_phase", "walk", "sampling"): 1,
        ("t6gps_workers_wanted", "walk"): 2,
        ("t6gps_workers", "walk", "idle"): sum(worker.phase == "idle" for worker in state.workers.values()),
        ("t6gps_worker_replacements_total", "walk", "crash"): state.counters["crashed"],
        ("t6gps_worker_replacements_total", "walk", "hang"): 0,
        ("t6gps_episodes_total", "walk"): ledger["committed"],
        ("t6gps_episode_failures_total", "walk", "error"): ledger["failures"],
        ("t6gps_episodes_quarantined", "walk"): 1,
        ("t6gps_spool_bytes", "walk"): Spool(run.spool, 1).path(1).stat().st_size,
        ("t6gps_iterations_total", "walk"): 1,
        ("t6gps_control_steps_total", "walk"): 600,
        ("t6gps_control_steps_per_second", "walk"): 200,
        ("t6gps_cost_square_meters_per_square_second", "walk"): 1.5,
        ("t6gps_forward_speed_meters_per_second", "walk"): 0.25,
        ("t6gps_stuck_ratio", "walk"): 0.125,
        ("t6gps_runs",): 1,
        ("t6gps_runs_left_out",): 0,
        ("t6gps_runs_unreadable",): 0,
    }
    assert {key: found[key] for key in expected} == expected
    assert expected["t6gps_worker_replacements_total", "walk", "crash"] > 0
    assert found["t6gps_phase_seconds_total", "walk", "sampling"] > 0


def test_labels_are_those_that_are_declared_and_have_few_values(root: Path) -> None:
    run = catalog.open_run(root, "walk")
    with catalog.locked(run):
        tell(run, troubled())
        said = json.loads((run.pool / "status.json").read_text())
        said |= {"phase": "another", "phases_s": {"another": 1.0}, "processes": {"another": 1}}
        (run.pool / "status.json").write_text(json.dumps(said))
        text = Exporter(root).text().decode()
    declared = {metric.name: metric for metric in METRICS}
    samples = [sample for family in text_string_to_metric_families(text) for sample in family.samples]
    for sample in samples:
        if sample.name in declared:
            metric = declared[sample.name]
            assert sample.labels.keys() == set(metric.labels)
            assert metric.label is None or sample.labels[metric.label] in metric.values
    assert "another" not in text


def test_names_follow_prometheus() -> None:
    for metric in METRICS:
        assert re.fullmatch(r"t6gps_[a-z_]+", metric.name)
        assert metric.name.endswith("_total") == (metric.kind is Kind.COUNTER), metric.name


@needs_promtool
def test_promtool_accepts_the_metrics(root: Path) -> None:
    run = catalog.open_run(root, "walk")
    with catalog.locked(run):
        tell(run, troubled())
        text = Exporter(root).text()
    check("check", "metrics", text=text)


def test_runs_at_work_come_first_then_the_newest_and_the_others_are_counted(tmp_path: Path) -> None:
    runs = [create(tmp_path, f"run-{number}") for number in range(6)]
    for number, run in enumerate(runs):
        os.utime(run.path / ".lock", (number, number))
    with catalog.locked(runs[1]):
        os.utime(runs[1].path / ".lock", (1, 1))
        found = numbers(Exporter(tmp_path, runs_most_n=3).text())
    shown = {run for name, *labels in found if name == "t6gps_run_up" for run in labels}
    assert shown == {"run-1", "run-4", "run-5"}
    assert (found["t6gps_runs",], found["t6gps_runs_left_out",]) == (6, 3)
    assert found["t6gps_run_up", "run-1"] == 1
    assert found["t6gps_run_up", "run-5"] == 0


def test_a_process_that_ended_without_a_word_leaves_its_last_state_and_no_present(root: Path) -> None:
    house = House(2, 12)
    house.sample()
    tell(catalog.open_run(root, "walk"), house)
    found = numbers(Exporter(root).text())
    assert found["t6gps_run_up", "walk"] == 0
    assert found["t6gps_run_state", "walk", "RUNNING"] == 1
    assert found["t6gps_episodes_total", "walk"] > 0
    assert not {"t6gps_workers", "t6gps_run_phase", "t6gps_episodes_backlog"} & {name for name, *_ in found}


def test_a_run_that_begins_or_ends_between_two_scrapes_is_seen(root: Path) -> None:
    run, exporter = catalog.open_run(root, "walk"), Exporter(root)
    found = []
    for _ in range(2):
        found.append(numbers(exporter.text())["t6gps_run_up", "walk"])
        with catalog.locked(run):
            found.append(numbers(exporter.text())["t6gps_run_up", "walk"])
    assert found == [0, 1, 0, 1]


def test_what_an_earlier_process_said_is_not_taken_for_the_present_ones(root: Path) -> None:
    run = catalog.open_run(root, "walk")
    tell(run, troubled())
    said = json.loads((run.pool / "status.json").read_text())
    (run.pool / "status.json").write_text(json.dumps(said | {"pid": said["pid"] + 1}))
    with catalog.locked(run):
        found = numbers(Exporter(root).text())
    assert found["t6gps_run_up", "walk"] == 1
    assert "t6gps_run_state" not in {name for name, *_ in found}


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("pool/status.json", b""),
        ("pool/status.json", b"[]"),
        ("pool/status.json", b"{}"),
        ("pool/status.json", b'{"pid": 1, "time_s": 0, "state": 3, "workers": [], "waits": []}'),
        ("config.json", b"{"),
        ("config.json", b"\xff"),
        ("tables/episodes/_delta_log/00000000000000000000.json", b"{"),
        ("tables/iterations/iteration-000000.parquet", b"PAR1"),
        ("tables/iterations/iteration-000000.parquet", None),
    ],
)
def test_a_damaged_run_is_counted_and_hides_no_other_and_nothing_else_of_itself(
    root: Path, file: str, content: bytes | None
) -> None:
    create(root, "other")
    run = catalog.open_run(root, "walk")
    run.pool.mkdir()
    if content is None:
        (run.path / file).unlink()
    else:
        (run.path / file).write_bytes(content)
    found = numbers(Exporter(root).text())
    assert found["t6gps_runs_unreadable",] == 1
    assert found["t6gps_run_up", "other"] == 0
    assert found["t6gps_run_up", "walk"] == 0
    assert found["t6gps_iterations_planned", "other"] > 0


def test_the_table_of_a_run_is_read_again_only_when_an_iteration_was_committed(
    root: Path, make_episode: Callable[..., Episode]
) -> None:
    run, exporter = catalog.open_run(root, "walk"), Exporter(root)
    assert numbers(exporter.text())["t6gps_iterations_total", "walk"] == 1
    whole = run.tables / "iterations" / "iteration-000000.parquet"
    kept = whole.read_bytes()
    whole.write_bytes(b"")  # whoever read it now would find it damaged
    assert numbers(exporter.text())["t6gps_iterations_total", "walk"] == 1
    whole.write_bytes(kept)
    commit(run, 1, make_episode)
    assert numbers(exporter.text())["t6gps_iterations_total", "walk"] == 2


def test_a_root_that_is_not_there_yet_has_no_runs(tmp_path: Path) -> None:
    found = numbers(Exporter(tmp_path / "none").text())
    assert found["t6gps_runs",] == 0

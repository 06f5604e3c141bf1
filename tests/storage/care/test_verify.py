"""Laws of verifying: every planted damage is found where it is, and a sound run has none, at work or of old."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from threading import Event, Thread
from typing import Any

import pytest
from damages import DAMAGES, flip, rewrite

from t6gps.storage import catalog, durable, schema, tables
from t6gps.storage.care.verify import verify
from t6gps.storage.catalog import Run
from t6gps.storage.spool import Spool


@pytest.fixture
def spooled(worked: Run, make_episode: Any) -> Run:
    """The run `worked` with an episode of its next iteration."""
    Spool(worked.spool, 3).append(make_episode(300, 3))
    return worked


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_planted_damage_is_found_in_its_part_and_nowhere_else(spooled: Run, damage: str) -> None:
    assert verify(spooled) == []
    part, plant = DAMAGES[damage]
    plant(spooled)
    faults = verify(spooled)
    assert {fault.part for fault in faults} == {part}
    assert faults[0].place.startswith("tables" if part in schema.TABLES else part)
    assert "\n" not in str(faults[0])


def test_any_bit_of_a_tables_file_that_has_changed_is_found(worked: Run) -> None:
    file = worked.tables / "iterations" / "iteration-000001.parquet"
    whole = file.read_bytes()
    for place in range(0, len(whole), len(whole) // 9):
        flip(file, place)
        assert [fault.part for fault in verify(worked)] == ["iterations"], place
        file.write_bytes(whole)


def test_an_empty_run_a_cut_off_commit_and_a_policy_without_tables_are_sound(
    run: Run, commit_cut_off: Any, worked: Run
) -> None:
    assert verify(run) == []
    shutil.copytree(worked.checkpoints, run.checkpoints, dirs_exist_ok=True)
    for path in run.checkpoints.iterdir():  # as that of a baseline
        manifest = path / "manifest.json"
        manifest.write_text(manifest.read_text().replace('"ledger"', '"other"'))
        (path / "DONE").write_text(durable.sha256(manifest))
    assert verify(run) == []
    commit_cut_off(worked, 3, "frames classes", "models")
    assert verify(worked) == []


@pytest.mark.slow
def test_a_run_that_works_meanwhile_has_no_fault(worked: Run, iterate: Any, evaluate: Any) -> None:
    ended = Event()

    def work() -> None:
        for number in range(3, 8):
            iterate(worked, number)
            evaluate(worked, number)
        ended.set()

    working, rounds_n = Thread(target=work), 0
    working.start()
    while not ended.is_set() and working.is_alive():
        assert verify(worked) == []
        rounds_n += 1
    working.join()
    assert ended.is_set() and rounds_n > 1
    assert verify(worked) == []
    assert tables.committed_iterations(worked) == 8


LATER = {"iterations": {1: 5, 2: 2, 3: 1, 4: 1}, "classes": {1: 3}, "frames": dict.fromkeys(range(1, 6), 2)}
"""How many columns of a table a version had not."""


@pytest.mark.parametrize("version", range(1, 6))
def test_runs_of_earlier_versions_have_no_fault(tmp_path: Path, iterate: Any, version: int) -> None:
    """They lack tables and columns, their commits have no digests, and their pages no sums."""
    run = catalog.create(tmp_path, "old", "{}")
    iterate(run, 0)
    for name in schema.OF_ITERATIONS:
        if name in schema.YOUNGER:
            shutil.rmtree(run.tables / name)
            continue
        lacking_n = LATER.get(name, {}).get(version, 0)
        rewrite(run, name, 0, lambda rows, n=lacking_n: rows.select(rows.column_names[: rows.num_columns - n])
                .replace_schema_metadata({"t6gps_schema_version": str(version)}), digest=False)  # fmt: skip
    assert verify(run) == []
    iterate(run, 1)
    assert verify(run) == []
    os.truncate(run.tables / "episodes" / "iteration-000000.parquet", 100)
    assert {fault.part for fault in verify(run)} == {"episodes"}

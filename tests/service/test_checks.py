"""Laws of the checks before a start: where all is well they say so, and each fault is named with what helps."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from t6gps.service import advice, checks, machine
from t6gps.service.checks import Wanted
from t6gps.storage.errors import RunError

TWO = Wanted(2, Path("runs"))


def test_nothing_stops_a_start_on_this_machine() -> None:
    stopping = [finding for finding in (check(TWO) for check in checks.ALL) if finding.stops and not finding.good]
    assert stopping == []
    checks.require(checks.OWN_RAY, TWO)


def test_the_first_fault_stops_a_start_with_what_was_found_what_is_needed_and_what_helps() -> None:
    with pytest.raises(RunError, match=r"open files: \d+; needed: \d{9,} for .* workers; raise the hard limit"):
        checks.require(checks.OWN_RAY, Wanted(10**8))


@pytest.mark.parametrize("address", ["", "local"])
def test_addresses_that_mean_a_ray_of_ones_own_for_ray_mean_it_here(
    address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    assert checks.cluster_address() is None
    assert checks.cluster(TWO).good


@pytest.mark.parametrize(
    ("address", "remedy"),
    [
        ("head", "correct it, or unset it"),
        ("head:", "correct it, or unset it"),
        (":6379", "correct it, or unset it"),
        ("head:ray", "correct it, or unset it"),
        ("http://head:6379", "correct it, or unset it"),
        ("ray://head:10001", "without ray://"),
        ("127.0.0.1:99999", "ray start --head"),
    ],
)
def test_an_address_that_cannot_be_a_heads_is_named_with_its_remedy(
    address: str, remedy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RAY_ADDRESS", address)
    finding = checks.cluster(TWO)
    assert address in finding.found
    assert remedy in finding.remedy


def test_an_address_at_which_somebody_listens_is_good(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        monkeypatch.setenv("RAY_ADDRESS", f"127.0.0.1:{server.getsockname()[1]}")
        assert checks.cluster(TWO).good


def test_a_root_that_is_a_file_or_in_one_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for root in (tmp_path / "file", tmp_path / "file" / "runs"):
        finding = checks.root_folder(Wanted(1, root))
        assert finding.stops
        assert str(tmp_path / "file") in finding.found
        assert finding.remedy


def test_a_root_in_a_session_folder_of_ray_is_refused_also_by_way_of_a_link(tmp_path: Path) -> None:
    session = tmp_path / "session_2026-11-27_16-36-18_123456_789"
    (session / "runtime_resources").mkdir(parents=True)
    (tmp_path / "session_latest").symlink_to(session)
    for place in (session, tmp_path / "session_latest"):
        finding = checks.root_folder(Wanted(1, place / "runtime_resources" / "runs"))
        assert finding.stops
        assert "--root elsewhere" in finding.remedy
    assert checks.root_folder(Wanted(1, tmp_path / "session_of_mine")).good


def test_a_root_that_is_yet_to_be_made_is_good_where_it_can_be_and_is_not_made_by_looking(tmp_path: Path) -> None:
    root = tmp_path / "a" / "b"
    assert checks.root_folder(Wanted(1, root)).good
    assert list(tmp_path.iterdir()) == []


def test_sockets_go_to_a_short_folder_where_the_one_named_is_too_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long = tmp_path / ("x" * machine.SOCKET_PATH_BYTES)
    monkeypatch.setenv("TMPDIR", str(long))
    monkeypatch.delenv("RAY_TMPDIR", raising=False)
    found = machine.temporary_folder()
    assert found is not None
    assert long not in found.parents
    assert len(str(found)) + len(machine.SOCKET_BELOW) <= machine.SOCKET_PATH_BYTES
    assert not long.exists()


def test_the_object_store_is_on_disk_where_shared_memory_is_small(tmp_path: Path) -> None:
    store = machine.object_store(tmp_path)
    assert machine.LEAST_STORE_BYTES <= store.nbytes <= machine.STORE_BYTES
    assert store.nbytes <= machine.free_bytes(store.folder)


def test_descriptors_are_as_before_when_a_run_has_ended() -> None:
    code = (
        "import resource; from t6gps.service import machine\n"
        "hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (64, hard))\n"
        "with machine.all_descriptors(): print(resource.getrlimit(resource.RLIMIT_NOFILE)[0] == hard)\n"
        "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert done.stdout.split() == ["True", "64"]


@pytest.mark.parametrize("number", sorted(advice.REMEDIES))
def test_advice_names_the_path_the_trouble_and_what_helps(number: int) -> None:
    text = advice.sentence(OSError(number, os.strerror(number), "runs/one"))
    assert text == f"runs/one: {os.strerror(number)}; {advice.REMEDIES[number]}"


def test_advice_without_a_path_names_the_folder_where_the_program_was_at_work() -> None:
    error = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert advice.sentence(error, Path("runs/one")).startswith("runs/one: No space left")
    assert advice.sentence(error).startswith("No space left")


def test_an_error_that_nothing_is_known_about_gets_no_advice() -> None:
    assert advice.sentence(OSError("a library's own")) == "a library's own"

"""Laws of the process that is kept warm for queries: one for many, of one thread, replaced, gone with its owner."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import QueryError
from t6gps.storage.sql import warm
from t6gps.storage.sql.query import Question, query

ENDLESS = "WITH RECURSIVE t(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM t) SELECT count(*) FROM t"
SCRIPT = f"""
import sys
from pathlib import Path
from t6gps.storage import catalog
from t6gps.storage.sql import warm
from t6gps.storage.sql.query import Question, query
run = catalog.open_run(Path(sys.argv[1]), "empty")
print(query(Question([run], "SELECT 1 AS one")).to_pylist(), warm.running().pid, flush=True)
if len(sys.argv) > 2:
    query(Question([run], {ENDLESS!r}))
"""
"""It has no guard of __main__, as scripts of users have none."""
GONE_S = 240.0


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return catalog.create(tmp_path_factory.mktemp("runs"), "empty", "{}")


def ids(question: Question) -> int:
    """Asks for one, and gives the process that was asked."""
    assert query(question).num_rows == 1
    return warm.running().pid


def children(pid: int) -> list[int]:
    """Processes that a process has started."""
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_there(pid: int) -> bool:
    """True for a process that has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_one_process_with_one_thread_starts_those_of_all_questions(empty: Run) -> None:
    questions = [Question([empty], f"SELECT {number} AS n") for number in range(6)]
    with ThreadPoolExecutor(3) as threads:
        (pid,) = set(threads.map(ids, questions))
    assert len(list(Path(f"/proc/{pid}/task").iterdir())) == 1
    assert not children(pid), "it waits for each that has ended"


def test_one_that_was_stopped_leaves_nothing_and_another_is_answered_meanwhile(
    empty: Run, wait_until: Callable[..., None]
) -> None:
    with ThreadPoolExecutor(1) as threads:
        stopped = threads.submit(query, Question([empty], ENDLESS, timeout_s=2.0))
        assert query(Question([empty], "SELECT 1")).num_rows == 1
        with pytest.raises(QueryError, match="stopped after 2 s"):
            stopped.result()
    wait_until(lambda: not children(warm.running().pid), GONE_S)


def test_one_that_is_killed_says_so_and_is_replaced(empty: Run, wait_until: Callable[..., None]) -> None:
    pid = ids(Question([empty], "SELECT 1"))
    with ThreadPoolExecutor(1) as threads:
        asked = threads.submit(query, Question([empty], ENDLESS, timeout_s=GONE_S))
        wait_until(lambda: bool(children(pid)), GONE_S)
        os.kill(pid, signal.SIGKILL)
        with pytest.raises(QueryError, match=r"process that starts queries has ended.*ask again"):
            asked.result(GONE_S)
    assert ids(Question([empty], "SELECT 1")) != pid


def test_a_script_without_a_guard_asks_and_leaves_nothing_behind(
    empty: Run, tmp_path: Path, wait_until: Callable[..., None]
) -> None:
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    done = subprocess.run(
        [sys.executable, "-W", "error", script, empty.path.parent], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = done.stdout.splitlines()
    assert line.startswith("[{'one': 1}] ")
    assert not is_there(int(line.split()[-1]))


def test_a_question_ends_with_whoever_asked_it(empty: Run, wait_until: Callable[..., None]) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, empty.path.parent, "endless"], stdout=subprocess.PIPE, text=True
    ) as asker:
        assert asker.stdout is not None
        pid = int(asker.stdout.readline().split()[-1])
        wait_until(lambda: bool(children(pid)), GONE_S)
        started = [pid, *children(pid)]
        asker.kill()
    wait_until(lambda: not any(map(is_there, started)), GONE_S)

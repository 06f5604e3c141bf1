"""Ways to mend a damaged run with nothing lost: from a copy, by building a log anew, from the spool.

Each changes a draft of the run, in which files are links to the run's own: files are replaced, never written to.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Mapping
from pathlib import Path

import pyarrow as pa

from t6gps.storage import durable, schema, spool
from t6gps.storage.care import commits, delta_files
from t6gps.storage.care.fault import Fault, within
from t6gps.storage.catalog import Run
from t6gps.storage.delta import checkpoints, iterations, log, parquet
from t6gps.storage.errors import DataError, RunError

DAMAGED = "damaged"


def set_aside(draft: Run, place: str, ending: str = "") -> None:
    """Move a file or folder to where damaged ones are kept, under its name with an ending, or a number that is free."""
    path, number = draft.path / place, 1
    target = kept = draft.path / DAMAGED / f"{place}{ending}"
    while target.exists():
        number += 1
        target = kept.with_name(f"{kept.name}.{number}")
    if path.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        path.rename(target)


def without_obstacles(draft: Run) -> list[str]:
    """Set aside files that lie where the folders of tables belong; what was done."""
    tables = (f"tables/{table}{log_of}" for log_of in ("", "/_delta_log") for table in schema.TABLES)
    files = [place for place in ("tables", *tables) if (draft.path / place).is_file()]
    for place in files:
        set_aside(draft, place, ".file")  # so that what belongs there can be set aside, too
    return [f"{place} is set aside in {DAMAGED}/: it is no folder" for place in files]


def without_checkpoints(draft: Run, faults: Iterable[Fault]) -> dict[str, str]:
    """Set the checkpoints of logs aside that have a damaged one; what was wrong with it, by the table."""
    wrong = {fault.part: fault for fault in faults if fault.place.endswith(checkpoints.ENDING)}
    for fault in wrong.values():
        for state in checkpoints.kept((draft.path / fault.place).parent):
            set_aside(draft, within(draft, state))
    return {table: fault.what for table, fault in sorted(wrong.items())}


def told(wrong: Mapping[str, str], left: Iterable[Fault]) -> list[str]:
    """What was done by `without_checkpoints`.

    left   faults of the run without these checkpoints: those of a table say that its commits are not right either
    """
    also = {fault.part for fault in left}
    return [
        f"checkpoints of tables/{table}/_delta_log are set aside in {DAMAGED}/: {_why(what, table in also)}"
        for table, what in wrong.items()
    ]


def _why(what: str, also: bool) -> str:
    if what != commits.CONTRADICTED:
        return f"one cannot be read ({what}), and the log has all commits"
    return "they contradict the commits" + ("" if also else ", which fit the files")


def from_copy(draft: Run, copy: Run, faults: Iterable[Fault], unsound: Iterable[Fault]) -> list[str]:
    """Take from a copy what is damaged here and sound there; what was done. RunError for a copy of another run.

    unsound   faults of the copy
    """
    _check_same(draft, copy, {fault.part for fault in faults})
    spoilt = {fault.place for fault in unsound}
    sentences, taken = list[str](), list[str]()
    for place in sorted({fault.place for fault in faults}):
        source = copy.path / place
        if place in spoilt or not source.exists() or any(place.startswith(f"{whole}/") for whole in taken):
            continue
        taken.append(place)
        if place.endswith("_delta_log"):
            if _has_less(copy, draft, place):
                continue  # the log is built anew from the files
            _take_table(draft, copy, place)
        else:
            set_aside(draft, place)
            _take(source, draft.path / place)
        sentences.append(f"{place} is taken from {copy.path}")
    return sentences


def tables_from_copy(draft: Run, copy: Run, faults: Iterable[Fault], unsound: Iterable[Fault]) -> list[str]:
    """Take whole tables from a copy that has no less of them; what was done.

    Single files did not help, so tables contradict each other, and none says which of them is right.
    """
    sentences, spoilt = list[str](), {fault.part for fault in unsound}
    if not any(fault.part in schema.TABLES for fault in faults):
        return sentences
    for table in (name for name in schema.TABLES if name not in spoilt and (copy.tables / name).exists()):
        here, there = (delta_files.opened(run, table).committed_n for run in (draft, copy))
        if there >= here:
            place = f"tables/{table}"
            set_aside(draft, place)
            _take(copy.path / place, draft.path / place)
            sentences.append(f"{place} is taken from {copy.path}")
    return sentences


def _check_same(draft: Run, copy: Run, damaged: set[str]) -> None:
    compared = [part for part in ("config", "origin") if part not in damaged]
    for part in compared:
        here, there = (run.path / f"{part}.json" for run in (draft, copy))
        if here.exists() and (not there.exists() or here.read_bytes() != there.read_bytes()):
            raise RunError(
                f"{copy.path} is no copy of this run: its {there.name} differs; give a copy of the run itself"
            )
    if not compared:
        raise RunError(
            "neither config.json nor origin.json of the run can be read, so no copy can be told to be its own"
        )


def _has_less(copy: Run, draft: Run, place: str) -> bool:
    """True where the log of a copy knows fewer files of a table than lie here."""
    folder = Path(place).parent
    return delta_files.opened(copy, folder.name).committed_n < len(list((draft.path / folder).glob("*.parquet")))


def _take_table(draft: Run, copy: Run, place: str) -> None:
    """Exchange a log for that of the copy, and take the files that are missing here."""
    set_aside(draft, place)
    _take(copy.path / place, draft.path / place)
    for source in (copy.path / place).parent.glob("*.parquet"):
        here = draft.path / Path(place).parent / source.name
        if not here.exists():
            _take(source, here)


def _take(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    if source.is_dir():
        shutil.copytree(source, target)
    else:
        shutil.copy2(source, target)


def rebuilt_logs(draft: Run, faults: Iterable[Fault]) -> list[str]:
    """Build the damaged logs of tables anew from their files, as far as these are whole; what was done."""
    sentences = []
    for table in sorted({fault.part for fault in faults if fault.repairable and "_delta_log" in fault.place}):
        files = _whole_files(draft, table)
        if not files:
            continue
        set_aside(draft, f"tables/{table}/_delta_log")
        for number, file in files.items():
            log.add_again(draft, table, number, file)
        sentences.append(f"tables/{table}/_delta_log is built anew from {len(files)} files")
    return sentences


def _whole_files(draft: Run, table: str) -> dict[int, Path]:
    """Files of a table by their numbers; of iterations as many as follow each other."""
    whole = dict[int, Path]()
    for path in sorted((draft.tables / table).glob("*.parquet")):
        number = delta_files.number_of(path.name)
        found = delta_files.Found(table)
        delta_files.examine(draft, found, delta_files.Entry(path, path.stat().st_size, None, None, {}))
        if number is None or found.faults or (table in schema.OF_ITERATIONS and whole and number - 1 not in whole):
            break
        whole[number] = path
    return whole


def from_spool(draft: Run, faults: Iterable[Fault]) -> list[str]:
    """Write damaged files of episodes and frames anew where the spool has the episodes still; what was done."""
    sentences = []
    for fault in faults:
        if fault.part not in ("frames", "episodes") or fault.number is None or "_delta_log" in fault.place:
            continue
        entries = {entry.path.name: entry for entry in delta_files.opened(draft, fault.part).files}
        entry = entries.get(Path(fault.place).name)
        files = sorted((draft.spool / f"iteration-{fault.number:06d}").glob("episode-*.arrow"))
        if entry is None or not files:
            continue
        rewritten = draft.path / "spool" / f"{fault.part}.parquet"
        try:
            _write(fault.part, rewritten, files)
        except (pa.ArrowException, OSError, DataError):
            continue  # the spool is torn as well, which is a fault of its own
        if durable.sha256(rewritten) == entry.sha256:
            set_aside(draft, fault.place)
            rewritten.rename(entry.path)
            sentences.append(f"{fault.place} is written anew from the spool")
        else:
            rewritten.unlink()
    return sentences


def _write(table: str, target: Path, files: list[Path]) -> None:
    summaries: list[pa.Table] = []
    groups = iterations.row_groups((spool.read(file) for file in files), str(target.parent), summaries)
    if table == "frames":
        parquet.write(target, schema.FRAMES, groups)
        return
    for _ in groups:
        pass
    parquet.write(target, schema.EPISODES, [pa.concat_tables(summaries).cast(schema.EPISODES)])

"""What tables say of each other: every reference leads somewhere, and every count is right.

    frames -> episodes -> iterations -> policies <- evaluations <- evaluation_episodes <- evaluation_frames
    classes, models -> iterations

A table with a fault of its own is not held against others.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import TypeAlias

from t6gps.storage import schema
from t6gps.storage.care.delta_files import Found, rows
from t6gps.storage.care.fault import Fault

Tables: TypeAlias = Mapping[str, Found]
Key: TypeAlias = tuple[int | None, int | None]


def faults(tables: Tables, iterations_n: int, complete_policies: bool) -> Iterator[Fault]:
    """What does not fit among `iterations_n` iterations and the evaluations that stand in their table.

    complete_policies   the run has kept every policy since its first
    """
    evaluated = {row["evaluation_id"] for row in rows(tables["evaluations"])}
    yield from _frames(tables, "", "iteration", set(range(iterations_n)))
    yield from _frames(tables, "evaluation_", "evaluation_id", evaluated)
    yield from _counts(tables, "episodes", "iterations", "iteration", set(range(iterations_n)))
    yield from _counts(tables, "evaluation_episodes", "evaluations", "evaluation_id", evaluated)
    yield from _iterations(tables, iterations_n)
    known = {
        **{name: set[int | None](range(iterations_n)) for name in schema.OF_ITERATIONS},
        **dict.fromkeys(schema.OF_EVALUATIONS, evaluated),
    }
    yield from _versions(tables, iterations_n, complete_policies)
    yield from _unknown(tables, known)


def _sound(tables: Tables, *names: str) -> bool:
    return not any(tables[name].faults for name in names)


def _fault(table: str, number: int | None, what: str) -> Fault:
    return Fault(table, f"tables/{table}", what, number)


def _frames(tables: Tables, prefix: str, group: str, known: set[int | None]) -> Iterator[Fault]:
    """Episodes whose frames are not steps + 1 under the same policy, and frames of no episode; one a group."""
    frames, episodes = f"{prefix}frames", f"{prefix}episodes"
    if not _sound(tables, frames, episodes):
        return
    there: dict[Key, list[tuple[int, int | None]]] = {}
    for row in rows(tables[frames]):
        there.setdefault((row[group], row["episode_id"]), []).append((row["frames"] or 0, row["policy_version"]))
    seen: set[Key] = set()
    wrong: dict[int | None, list[str]] = {}
    for row in rows(tables[episodes]):
        key = (row[group], row["episode_id"])
        if row[group] not in known:
            continue
        found = there.get(key, [])
        if found != [((row["steps"] or 0) + 1, row["policy_version"])] or key in seen:
            counted = " + ".join(str(count) for count, _ in found) or "no"
            what = f"episode {key[1]} of {row['steps']} steps has {counted} frames"
            versions = {version for _, version in found}
            if key in seen:
                what = f"episode {key[1]} stands twice in {episodes}"
            elif versions and versions != {row["policy_version"]}:
                what = (
                    f"episode {key[1]} is of policy {row['policy_version']}, its frames of {sorted(map(str, versions))}"
                )
            wrong.setdefault(row[group], []).append(what)
        seen.add(key)
    for number, sentences in wrong.items():
        yield _fault(frames, number, _first(sentences))
    orphans: dict[int | None, list[str]] = {}
    for number, episode in there.keys() - seen:
        if number in known:
            orphans.setdefault(number, []).append(f"episode {episode} has frames and no row")
    for number, sentences in orphans.items():
        yield _fault(episodes, number, _first(sorted(sentences)))


def _first(sentences: list[str]) -> str:
    return sentences[0] + (f", and {len(sentences) - 1} more" if len(sentences) > 1 else "")


def _counts(tables: Tables, episodes: str, of: str, group: str, known: set[int | None]) -> Iterator[Fault]:
    """Iterations or evaluations that have another number of episodes, or of their steps, than they say."""
    if not _sound(tables, episodes, of):
        return
    counted, steps = Counter[int | None](), Counter[int | None]()
    for row in rows(tables[episodes]):
        counted[row[group]] += 1
        steps[row[group]] += row["steps"] or 0
    for row in rows(tables[of]):
        number = row[group]
        if number not in known:
            continue
        if row["episodes"] != counted[number]:
            yield _fault(episodes, number, f"{group} {number} has {row['episodes']} episodes, found {counted[number]}")
        elif row.get("steps", steps[number]) != steps[number]:
            yield _fault(episodes, number, f"{group} {number} has {row['steps']} steps, found {steps[number]}")


def _iterations(tables: Tables, iterations_n: int) -> Iterator[Fault]:
    """Iterations that are missing or stand twice, and rows of iterations that there are none of."""
    if not _sound(tables, "iterations"):
        return
    counted = Counter(row["iteration"] for row in rows(tables["iterations"]))
    for iteration in range(iterations_n):
        if counted[iteration] != 1:
            yield _fault("iterations", iteration, f"iteration {iteration} has {counted[iteration]} rows, not one")
    most = max((number for number in counted if number is not None), default=-1)
    for table in ("episodes", "classes", "models"):
        if _sound(tables, table):
            for number in sorted(_others(tables[table], most)):
                yield _fault(table, None, f"it has rows of iteration {number}, which is not in iterations")


def _others(found: Found, most: int) -> set[int]:
    numbers = {row["iteration"] for row in rows(found)}
    # Of a commit under way, `iterations` knows nothing yet.
    return {number for number in numbers if number is not None and not 0 <= number <= most + 1}


def _versions(tables: Tables, iterations_n: int, complete: bool) -> Iterator[Fault]:
    """Policies that are missing, stand twice, or have another parent than the one before."""
    if not _sound(tables, "policies"):
        return
    counted = Counter(row["version"] for row in rows(tables["policies"]))
    versions = {version for version in counted if version is not None}
    if not versions:
        return
    first = 0 if complete else min(versions)
    for version in range(first, iterations_n + 1):
        if counted[version] != 1:
            yield _fault("policies", max(version - 1, 0), f"policy {version} has {counted[version]} rows, not one")
    for row in rows(tables["policies"]):
        before = None if not row["version"] else row["version"] - 1
        if (row["parent"], row["iteration"]) != (before, before):
            yield _fault("policies", before, f"policy {row['version']} has the parent {row['parent']}, not {before}")


def _unknown(tables: Tables, known: Mapping[str, set[int | None]]) -> Iterator[Fault]:
    """Policies that others refer to and that there are none of; a run of an earlier version lacks the first ones."""
    versions = {row["version"] or 0 for row in rows(tables["policies"])}
    if not versions or not _sound(tables, "policies"):
        return
    for table in ("episodes", "iterations", "evaluations", "evaluation_episodes"):
        group = "iteration" if table in schema.OF_ITERATIONS else "evaluation_id"
        used = {row["policy_version"] or 0 for row in rows(tables[table]) if row[group] in known[table]}
        for version in sorted(used - versions if _sound(tables, table) else ()):
            if version >= min(versions):
                yield _fault(table, None, f"it refers to policy {version}, which is not in policies")

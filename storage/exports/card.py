"""The card of a dataset, its README.md: what it is, columns with units, statistics, where every episode comes from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import pyarrow as pa
import yaml

from t6gps.storage import schema
from t6gps.storage.exports.format import Format
from t6gps.storage.exports.selection import Source
from t6gps.storage.exports.statistics import Moments, Totals
from t6gps.storage.sql import views


@dataclass(frozen=True)
class Asked:
    """What was asked for.

    runs      pattern of their names
    where     condition that episodes meet, None for all
    license   SPDX identifier of the licence of the data
    made_by   the program, with its version
    """

    runs: str
    where: str | None
    license: str
    made_by: str


def card(name: str, form: Format, asked: Asked, sources: Sequence[Source], totals: Totals) -> str:
    """The text, Markdown with the front matter of Hugging Face's dataset cards."""
    episodes_n = sum(source.summaries.num_rows for source in sources)
    steps_n = sum(sum(source.summaries.column("steps").to_pylist()) for source in sources)
    parts = [
        _front_matter(name, form, asked),
        f"# {name}\n",
        f"{episodes_n} episodes, in all {steps_n} control steps of {1 / views.STEPS_PER_S:g} s; runs: {len(sources)}. "
        "SUPERball, a simulated tensegrity robot of six bars and 24 cables, rolls towards waypoints. "
        f"Here they are {form.title}, written by {asked.made_by}.\n",
        f"Licence: {asked.license}.\n",
        f"```python\n{form.opening.format(path='.')}```\n",
        f"## Rows and columns\n\n{form.alignment}\n",
        _columns(form.columns),
        f"Numbers of canonical quantities are in the frame of the support triangle: cables and nodes are permuted by a "
        f"symmetry, the world is mirrored and turned. `{form.statistics}` has the statistics of each entry, and "
        "`episodes.parquet` the run of each episode, its seeds and how it went.\n",
        "## What this format does not hold\n",
        "".join(f"- {loss}\n" for loss in form.losses) or "Nothing is left out.\n",
        "## Statistics\n",
        _table(("column", "entries", "numbers each", "least", "mean", "deviation", "greatest"), _statistics(totals)),
        "## Episodes\n",
        _columns(schema.EPISODES),
        "## Where they come from\n",
        f"Runs `{asked.runs}`, "
        + ("all episodes" if asked.where is None else "episodes that meet the condition below")
        + ", numbered anew in the order of runs and episodes. `provenance` has each run's settings and origin.\n",
        "" if asked.where is None else f"```sql\n{asked.where.strip()}\n```\n",
        _table(tuple(sources[0].facts), [tuple(source.facts.values()) for source in sources]),
        _differing(sources),
    ]
    return "\n".join(part for part in parts if part)


def _front_matter(name: str, form: Format, asked: Asked) -> str:
    facts: dict[str, object] = {
        "license": asked.license.lower(),
        "pretty_name": name,
        "task_categories": ["robotics", "reinforcement-learning"],
        "tags": ["tensegrity", "superball", form.package],
    }
    if form.viewer is not None:
        facts["configs"] = [{"config_name": "default", "data_files": form.viewer}]
    return f"---\n{yaml.safe_dump(facts, sort_keys=False)}---\n"


def _columns(definition: pa.Schema) -> str:
    rows = views.described({"": definition}).to_pylist()
    cells = [(f"`{row['column_name']}`", row["type"], row["unit"], row["meaning"]) for row in rows]
    return _table(("column", "type", "unit", "meaning"), cells)


def _statistics(totals: Totals) -> list[tuple[object, ...]]:
    return [(f"`{name}`", len(found.count), int(found.count.max()), *_range(found)) for name, found in totals.items()]


def _range(found: Moments) -> tuple[str, ...]:
    """Over all entries of a column: the least, the mean, the deviation about it, the greatest."""
    known = found.count > 0
    if not known.any():
        return ("-",) * 4
    count, mean = found.count[known], (found.count * found.mean)[known].sum() / found.count.sum()
    squares = (found.squares[known] + count * (found.mean[known] - mean) ** 2).sum()
    numbers = (found.least[known].min(), mean, (squares / count.sum()) ** 0.5, found.most[known].max())
    return tuple(f"{number:.4g}" for number in numbers)


def _differing(sources: Sequence[Source]) -> str:
    """The settings that are not the same in all runs."""
    names = [name for name in sources[0].settings if len({str(source.settings[name]) for source in sources}) > 1]
    if not names:
        return "All settings are the same in these runs.\n" if len(sources) > 1 else ""
    rows = [(f"`{name}`", *(source.settings[name] for source in sources)) for name in names]
    return "Settings in which they differ:\n\n" + _table(("setting", *(source.run.name for source in sources)), rows)


def _table(headings: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [headings, ["---"] * len(headings), *rows]
    return "".join("| " + " | ".join(_cell(cell) for cell in line) + " |\n" for line in lines)


def _cell(cell: object) -> str:
    return "-" if cell is None else " ".join(str(cell).split()).replace("|", "\\|")

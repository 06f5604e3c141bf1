"""The columns of all that a query may ask, as Markdown for the page on data. Run as a program, it prints them."""

from __future__ import annotations

from collections.abc import Mapping

import pyarrow as pa

from t6gps.storage import schema
from t6gps.storage.sql import views


def columns() -> str:
    """One Markdown table per table and view: name, type, unit and meaning of every column."""
    parts = []
    for table, definition in _listed().items():
        alike = table.removeprefix("evaluation_")
        if alike != table:
            parts += [f"### {table}", "", f"As `{alike}`, with `evaluation_id` in the place of `iteration`.", ""]
            continue
        parts += [f"### {table}", "", "| column | type | unit | meaning |", "|---|---|---|---|"]
        for row in views.described({table: definition}).to_pylist():
            parts.append(f"| `{row['column_name']}` | {row['type']} | {row['unit']} | {row['meaning']} |")
        parts.append("")
    return "\n".join(parts).rstrip() + "\n"


def _listed() -> Mapping[str, pa.Schema]:
    """The tables as their files have them, then what queries have beside them."""
    return {**views.asked(), **schema.TABLES}


if __name__ == "__main__":
    print(columns(), end="")

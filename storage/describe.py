"""The columns of every table as Markdown, for the page on data. Run as a program, it prints them."""

from __future__ import annotations

from t6gps.storage import fields, schema


def columns() -> str:
    """One Markdown table per table of a run: name, type, unit and meaning of every column."""
    parts = []
    for table, definition in schema.TABLES.items():
        alike = table.removeprefix("evaluation_")
        if alike != table:
            parts += [f"### {table}", "", f"As `{alike}`, with `evaluation_id` in the place of `iteration`.", ""]
            continue
        parts += [f"### {table}", "", "| column | type | unit | meaning |", "|---|---|---|---|"]
        for field in definition:
            metadata = {key.decode(): value.decode() for key, value in field.metadata.items()}
            length = fields.vector_length(field)
            kind = str(field.type) if length is None else f"list<{field.type.value_type}>, {length}"
            unit = metadata["unit"] or "text"
            meaning = metadata["description"] + ("; may be null" if field.nullable else "")
            parts.append(f"| `{field.name}` | {kind} | {unit} | {meaning} |")
        parts.append("")
    return "\n".join(parts).rstrip() + "\n"


if __name__ == "__main__":
    print(columns(), end="")

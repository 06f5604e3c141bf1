from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from t6gps.storage import catalog, describe, schema

PAGE = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")


def test_the_page_describes_every_column_as_the_schema_does() -> None:
    assert PAGE.endswith(describe.columns()), "print the section anew: python -m t6gps.storage.describe"


def test_the_description_holds_every_column_with_its_unit() -> None:
    for definition in schema.TABLES.values():
        for field in definition:
            unit = field.metadata[b"unit"].decode() or "text"
            assert re.search(rf"^\| `{field.name}` \| [^|]+ \| {re.escape(unit)} \| ", describe.columns(), re.M)


def test_the_examples_of_the_page_run(tmp_path: Path, commit: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    commit(catalog.create(Path("runs"), "trial", "{}"), 0)
    examples = re.findall(r"^```python\n(.*?)^```", PAGE, re.M | re.S)
    assert len(examples) == 4
    found: dict[str, Any] = {}
    for example in examples:
        exec(compile(example, "docs/data.md", "exec"), found)
    assert found["costs"].num_rows == 1
    assert found["speeds"].num_rows == 18
    assert found["episode"].num_rows == found["first"].num_rows == 6
    assert found["episodes"].num_rows == 3

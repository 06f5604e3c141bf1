"""Laws of docs/scale.md: what it concludes is what its table says."""

from __future__ import annotations

import re
from types import ModuleType


def test_the_parts_that_the_page_calls_first_carry_the_fewest_workers(
    render: ModuleType, pages: dict[str, str]
) -> None:
    carried = {row[0]: int(row[-1].replace(",", "")) for row in render.load("scale")["rows"]}
    first, second, *_ = sorted(carried, key=lambda part: carried[part])
    (sentence,) = re.findall(r"The smallest number in the last column breaks first.*", pages["docs/scale.md"])
    called = re.findall(r"\*\*(.+?)\*\*", sentence)
    assert [part.split(" (")[0] for part in (first, second)] == called


def test_a_part_that_breaks_before_a_size_needs_more_than_the_head_has_there(render: ModuleType) -> None:
    measurement = render.load("scale")
    sizes = [int(column["name"].split()[0].replace(",", "")) for column in measurement["columns"][1:5]]
    for part, *needs, has, most in measurement["rows"]:
        for size, need in zip(sizes, needs, strict=True):
            lacks = float(need.replace(",", "")) > float(has.replace(",", ""))
            assert lacks == (size > int(most.replace(",", ""))), (part, size)

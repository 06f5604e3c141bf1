"""Laws of the page on the paper's figures: it lists them all."""

from __future__ import annotations

import re

from t6gps.service.views.paper import drawing


def test_the_page_lists_every_figure_in_its_order(pages: dict[str, str]) -> None:
    assert re.findall(r"^\| `(\w+)` \|", pages["docs/pictures.md"], re.MULTILINE) == list(drawing.FIGURES)

"""Laws of the terminal: a table says what it leaves out, and shows text as it is."""

from __future__ import annotations

import pytest

from t6gps.service.views import terminal
from t6gps.storage.sql.query import Head


def printed(capsys: pytest.CaptureFixture[str], head: Head) -> list[str]:
    terminal.print_head(head)
    return capsys.readouterr().out.splitlines()


def test_a_table_that_shows_everything_has_no_note(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(capsys, Head(["a", "b"], [["1", None], ["2", "x"]], 2, False))
    assert len(lines) == 6
    assert [cell.strip() for cell in lines[3].split("│")[1:-1]] == ["1", "-"]


@pytest.mark.parametrize(
    ("head", "note"),
    [
        (Head(["a"], [["1"]], 3, False), "1 of 3 rows shown; --format csv gives all"),
        (Head([f"a{n:036d}" for n in range(9)], [], 0, False), "4 of 9 columns shown; --format csv gives all"),
        (Head(["a"], [["x..."]], 1, True), "long values shortened; --format csv gives all"),
    ],
)
def test_what_is_left_out_is_counted(capsys: pytest.CaptureFixture[str], head: Head, note: str) -> None:
    lines = printed(capsys, head)
    assert lines[-1] == note
    assert max(map(len, lines)) <= 200


def test_a_column_wider_than_the_terminal_is_shown_all_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed(capsys, Head(["a" * 300, "b"], [["1", "2"]], 1, False))
    assert lines[-1].startswith("1 of 2 columns shown")
    assert max(map(len, lines)) <= 200


def test_text_is_shown_as_it_is_and_does_not_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    texts = ["[/bold] :smile:", "a\nb", "\x1b[31mred", "é"]
    lines = printed(capsys, Head(["text"], [[text] for text in texts], 4, False))
    assert [line.split("│")[1].strip() for line in lines[3:7]] == [texts[0], "a\\nb", "\\x1b[31mred", "é"]

"""Laws of picking episodes: by mean forward speed, each once, or one error that says what is allowed."""

from __future__ import annotations

import pyarrow as pa
import pytest

from t6gps.service.views.picks import picked
from t6gps.storage.errors import ConfigError

EPISODES = pa.table({"episode_id": [5, 6, 7, 8, 9], "forward_speed_m_per_s": [0.2, 0.9, -0.1, 0.9, 0.3]})


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("best:1", [6]),
        ("best:3", [6, 8, 9]),
        ("worst:2", [7, 5]),
        ("worst:1, best:2", [7, 6, 8]),
        ("best:4,worst:4", [6, 8, 9, 5, 7]),
    ],
)
def test_best_and_worst_are_those_of_the_forward_speed(text: str, found: list[int]) -> None:
    assert picked(text, EPISODES) == found


@pytest.mark.parametrize("text", ["", "best", "best:0", "best:-1", "fastest:2", "best:1,", "best:1 worst:1", "best:x"])
def test_another_text_is_refused_with_an_example(text: str) -> None:
    with pytest.raises(ConfigError, match="for example best:3,worst:3"):
        picked(text, EPISODES)


def test_more_than_there_are_is_refused() -> None:
    with pytest.raises(ConfigError, match="best:6 wants more than the 5 episodes"):
        picked("best:6", EPISODES)

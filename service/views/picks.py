"""Picking episodes by how they went: best and worst by mean forward speed."""

from __future__ import annotations

import re

import pyarrow as pa

from t6gps.storage.errors import ConfigError

PICK = re.compile(r"(best|worst):([1-9][0-9]{0,8})")
SPEED = "forward_speed_m_per_s"


def picked(text: str, episodes: pa.Table) -> list[int]:
    """Episodes that `text`, such as "best:3,worst:3", picks by mean forward speed; of equal ones the earlier.

    `episodes` has the columns episode_id and forward_speed_m_per_s. ConfigError for another text, or for more episodes
    than there are.
    """
    found = list[int]()
    for part in text.split(","):
        match = PICK.fullmatch(part.strip())
        if match is None:
            raise ConfigError(
                f"--pick takes best:N and worst:N, with commas between; found '{part}'; for example best:3,worst:3"
            )
        which, number = match[1], int(match[2])
        if number > episodes.num_rows:
            raise ConfigError(f"--pick {part.strip()} wants more than the {episodes.num_rows} episodes that there are")
        way = "descending" if which == "best" else "ascending"
        ordered = episodes.sort_by([(SPEED, way), ("episode_id", "ascending")])
        found += ordered["episode_id"].slice(0, number).to_pylist()
    return list(dict.fromkeys(found))

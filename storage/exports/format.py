"""What a format of datasets is: a function that writes episodes, and what its card says."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import pyarrow as pa

from t6gps.storage.exports.selection import Numbered
from t6gps.storage.exports.statistics import Totals

Write: TypeAlias = Callable[[Path, str, Iterator[Numbered]], Totals]
"""Writes episodes into a folder, for a dataset of a name; gives the statistics of its columns."""


@dataclass(frozen=True)
class Format:
    """A format in which episodes leave.

    title        what it is, in words
    package      what opens it
    write        writes it
    columns      what an episode is made of there: type, unit and meaning
    alignment    how states, actions and what followed stand to each other, in sentences
    opening      Python that opens the dataset {path} with the foreign package
    viewer       its Parquet files with rows, for viewers of Hugging Face; None without
    losses       what of a run it does not hold, in sentences
    statistics   the file of the dataset that has them
    """

    title: str
    package: str
    write: Write
    columns: pa.Schema
    alignment: str
    opening: str
    losses: tuple[str, ...]
    viewer: str | None
    statistics: str = "statistics.json"

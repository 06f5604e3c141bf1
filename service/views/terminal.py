"""What a person sees: progress while a run works, tables when it is done."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from itertools import accumulate
from types import TracebackType
from typing import Any

from rich.cells import cell_len
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table

from t6gps.learner.phases import PHASES
from t6gps.service import logs
from t6gps.service.training.evaluation import Evaluation
from t6gps.storage.sql.query import Head

_log = logging.getLogger(__name__)
console = Console(stderr=True)
"""Progress and messages go to stderr, results to stdout, so that results can be piped."""

LABELS = {logging.WARNING: ("warning: ", "yellow"), logging.ERROR: ("error: ", "red")}
"""What messages begin with, and their colour."""

PHASE_TITLES = {"sample": "sampling", **{phase.name: phase.title for phase in PHASES}, "evaluate": "evaluation"}
"""What the bar of each phase says."""

CELL_MARGIN_N = 3
"""Characters of a column beside its text: a space on both sides, and a line."""

LEARNING_COLUMNS = {
    "iteration": ("iteration", "{:d}"),
    "episodes": ("episodes", "{:d}"),
    "cost": ("cost", "{:.3f}"),
    "cost_standard_error": ("+-", "{:.3f}"),
    "forward_speed_m_per_s": ("forward m/s", "{:.3f}"),
    "forward_speed_standard_error": ("+-", "{:.3f}"),
    "stuck_share_by_distance": ("stuck", "{:.1%}"),
    "stuck_share": ("by speed", "{:.1%}"),
    "waypoints_per_episode": ("waypoints", "{:.2f}"),
    "sampling_s": ("sampling s", "{:.1f}"),
    "segmenting_s": ("segmenting s", "{:.1f}"),
    "fitting_s": ("fitting s", "{:.1f}"),
    "backward_pass_s": ("backward s", "{:.1f}"),
    "supervised_s": ("supervised s", "{:.1f}"),
}

CLASS_COLUMNS = {
    "kind": ("triangle", "{}"),
    "entry_edge": ("entry edge", "{}"),
    "exit_edge": ("exit edge", "{}"),
    "truncated": ("truncated", "{}"),
    "segments": ("segments", "{:d}"),
    "time_steps": ("time steps", "{:d}"),
    "pooled": ("pooled", "{}"),
    "modes": ("modes", "{:.2f}"),
    "residual": ("residual", "{:.2f}"),
    "cost": ("cost", "{:.3f}"),
    "predicted_cost_change": ("predicted change", "{:.3f}"),
    "policy_kl": ("KL nat", "{:.2f}"),
}

ARM_COLUMNS = {
    "arm": ("arm", "{}"),
    "seeds": ("seeds", "{:d}"),
    "steps": ("steps", "{:,}"),
    "forward_speed_m_per_s": ("forward m/s", "{:.3f}"),
    "forward_speed_m_per_s_deviation": ("+-", "{:.3f}"),
    "speed_over_winch_speed": ("over winch", "{:.2f}"),
    "bar_lengths_per_s": ("bars/s", "{:.2f}"),
    "cost_of_transport": ("transport", "{:.2f}"),
    "slip_per_metre": ("slip", "{:.2f}"),
    "stuck_share_by_distance": ("stuck", "{:.1%}"),
    "waypoints_per_episode": ("waypoints", "{:.2f}"),
    "cost": ("cost", "{:.3f}"),
    "cost_deviation": ("+-", "{:.3f}"),
    "wall_s": ("wall s", "{:.0f}"),
}


def say(sentence: str, level: int = logging.INFO) -> None:
    """Print a message as it is, on one line however wide the terminal; or log it, where lines are objects."""
    if logs.as_json():
        _log.log(level, "%s", sentence)
        return
    label, style = LABELS.get(level, ("", None))
    console.print(label + sentence, style=style, highlight=False, soft_wrap=True, markup=False)


def warn(sentence: str) -> None:
    """Print a warning."""
    say(sentence, logging.WARNING)


def _shows_bars() -> bool:
    return console.is_terminal and not logs.as_json()


class ProgressDisplay:
    """Shows a bar per phase of the current iteration and one line per finished iteration."""

    def __init__(self, iterations: int) -> None:
        self._iterations = iterations
        self._tasks: dict[tuple[int, str], TaskID] = {}
        self._progress = Progress(*_columns(), console=console, disable=not _shows_bars())

    def __enter__(self) -> ProgressDisplay:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def progress(self, iteration: int, phase: str, done: int, total: int) -> None:
        """Move the bar of a phase."""
        if (iteration, phase) not in self._tasks:
            place = f"iteration {iteration} of 0..{self._iterations - 1}: " if phase != "evaluate" else ""
            title = place + PHASE_TITLES[phase]
            self._tasks[iteration, phase] = self._progress.add_task(title)
        self._progress.update(self._tasks[iteration, phase], completed=done, total=total)

    def finished(self, row: dict[str, Any]) -> None:
        """Replace the bars of an iteration by its result."""
        for iteration, phase in list(self._tasks):
            if iteration == row["iteration"]:
                self._progress.remove_task(self._tasks.pop((iteration, phase)))
        learning_s = sum(row[key] for key in ("segmenting_s", "fitting_s", "backward_pass_s", "supervised_s"))
        say(
            f"iteration {row['iteration']}: "
            f"cost {_estimate(row['cost'], row['cost_standard_error'])}, "
            f"forward {_estimate(row['forward_speed_m_per_s'], row['forward_speed_standard_error'])} m/s, "
            f"sampled in {row['sampling_s']:.1f} s, learned in {learning_s:.1f} s"
        )


def _estimate(mean: float, standard_error: float | None) -> str:
    """A mean with its standard error, if there is one."""
    return f"{mean:.3f}" if standard_error is None else f"{mean:.3f} +- {standard_error:.3f}"


@contextmanager
def task(title: str) -> Iterator[Callable[[int, int], None]]:
    """A single bar; gives the function that moves it."""
    with Progress(*_columns(), console=console, transient=True, disable=not _shows_bars()) as progress:
        bar = progress.add_task(title, total=None)
        yield lambda done, total: progress.update(bar, completed=done, total=total)


class StudyDisplay:
    """Shows how far a study is: its sentences, and the bars of the run at work."""

    def say(self, sentence: str) -> None:
        """Print a sentence."""
        say(sentence)

    def warn(self, sentence: str) -> None:
        """Print a warning."""
        warn(sentence)

    def run(self, iterations: int) -> ProgressDisplay:
        """The bars of a run that is trained or evaluated."""
        return ProgressDisplay(iterations)

    def task(self, title: str) -> AbstractContextManager[Callable[[int, int], None]]:
        """A single bar; gives the function that moves it."""
        return task(title)


def _columns() -> tuple[ProgressColumn, ...]:
    return TextColumn("{task.description:<34}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()


def print_rows(title: str, rows: Sequence[Mapping[str, object]], columns: Mapping[str, tuple[str, str]]) -> None:
    """Print chosen columns of rows; a missing value is shown as '-'."""
    cells = [["-" if row[k] is None else form.format(row[k]) for k, (_, form) in columns.items()] for row in rows]
    _results().print(_table([heading for heading, _ in columns.values()], cells, title))


def print_head(head: Head) -> None:
    """Print the first rows and columns of a query's result, as many as fit, and say what is not shown."""
    target = _results()
    cells = [["-" if text is None else _printable(text, target.encoding) for text in row] for row in head.rows]
    headings = [_printable(name, target.encoding) for name in head.columns]
    shown_n = _fitting(headings, cells, target.width)
    target.print(_table(headings[:shown_n], [row[:shown_n] for row in cells]))
    counts = [
        f"{shown} of {whole} {kind}"
        for shown, whole, kind in ((len(cells), head.rows_n, "rows"), (shown_n, len(headings), "columns"))
        if shown < whole
    ]
    notes = [f"{', '.join(counts)} shown"] * bool(counts) + ["long values shortened"] * head.shortened
    if notes:
        target.print(f"{', '.join(notes)}; --format csv gives all")


def _results() -> Console:
    """Where tables go: as wide as the terminal, or 200 characters into files and pipes."""
    return Console(width=None if sys.stdout.isatty() else 200, markup=False, emoji=False, highlight=False)


def _table(headings: Sequence[str], rows: Sequence[Sequence[str]], title: str | None = None) -> Table:
    table = Table(title=title, title_justify="left")
    for heading in headings:
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*row)
    return table


def _fitting(headings: Sequence[str], rows: Sequence[Sequence[str]], width: int) -> int:
    """How many of the first columns fit into a table of `width` characters; one at least."""
    widths = [max(map(cell_len, column)) + CELL_MARGIN_N for column in zip(headings, *rows, strict=True)]
    return max(1, sum(total < width for total in accumulate(widths)))


def _printable(text: str, encoding: str) -> str:
    """Text on one line, with escapes for what would steer the terminal or is not in its encoding."""
    steady = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
    return steady.encode(encoding, "backslashreplace").decode(encoding)


def print_evaluation(result: Evaluation) -> None:
    """Print what `evaluate` measured."""
    title = f"Noise-free policy, {result.episodes} unseen episodes (seed {result.seed})"
    columns = {"key": ("quantity", "{}"), "mean": ("mean", "{:.4f}"), "standard_error": ("standard error", "{:.4f}")}
    print_rows(title, [{"key": name, **asdict(estimate)} for name, estimate in result.estimates().items()], columns)

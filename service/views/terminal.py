"""What a person sees: progress while a run works, tables when it is done."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict
from types import TracebackType
from typing import Any

import pyarrow as pa
import pyarrow.csv
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
from t6gps.service.training.evaluation import Evaluation

console = Console(stderr=True)
"""Progress and messages go to stderr, results to stdout, so that results can be piped."""

PHASE_TITLES = {"sample": "sampling", **{phase.name: phase.title for phase in PHASES}, "evaluate": "evaluation"}
"""What the bar of each phase says."""

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
    "stuck_share_by_distance": ("stuck", "{:.1%}"),
    "stuck_share_by_speed": ("by speed", "{:.1%}"),
    "waypoints_per_episode": ("waypoints", "{:.2f}"),
    "cost": ("cost", "{:.3f}"),
    "cost_deviation": ("+-", "{:.3f}"),
    "wall_s": ("wall s", "{:.0f}"),
}


def say(sentence: str, style: str | None = None) -> None:
    """Print a message as it is, on one line however wide the terminal."""
    console.print(sentence, style=style, highlight=False, soft_wrap=True, markup=False)


def warn(sentence: str) -> None:
    """Print a warning."""
    say(f"warning: {sentence}", style="yellow")


class ProgressDisplay:
    """Shows a bar per phase of the current iteration and one line per finished iteration."""

    def __init__(self, iterations: int) -> None:
        self._iterations = iterations
        self._tasks: dict[tuple[int, str], TaskID] = {}
        self._progress = Progress(*_columns(), console=console, disable=not console.is_terminal)

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
    with Progress(*_columns(), console=console, transient=True, disable=not console.is_terminal) as progress:
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
    table = Table(title=title, title_justify="left")
    for heading, _ in columns.values():
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(*("-" if row[k] is None else form.format(row[k]) for k, (_, form) in columns.items()))
    Console(width=None if sys.stdout.isatty() else 200).print(table)


def print_evaluation(result: Evaluation) -> None:
    """Print what `evaluate` measured."""
    title = f"Noise-free policy, {result.episodes} unseen episodes (seed {result.seed})"
    columns = {"key": ("quantity", "{}"), "mean": ("mean", "{:.4f}"), "standard_error": ("standard error", "{:.4f}")}
    print_rows(title, [{"key": name, **asdict(estimate)} for name, estimate in result.estimates().items()], columns)


def write_table(table: pa.Table, form: str) -> None:
    """Write a query's result to stdout as table, csv, json (a list of rows) or arrow (an IPC stream)."""
    table = table.rename_columns(_distinct(table.column_names))
    if form == "arrow":
        with pa.ipc.new_stream(sys.stdout.buffer, table.schema) as stream:
            stream.write_table(table)
    elif form == "csv":
        pyarrow.csv.write_csv(_with_text_lists(table), sys.stdout.buffer)
    elif form == "json":
        json.dump([_finite(row) for row in table.to_pylist()], sys.stdout, default=str, allow_nan=False)
        sys.stdout.write("\n")
    else:
        shown = Table()
        for name in table.column_names:
            shown.add_column(name, justify="right", overflow="fold")
        for row in table.to_pylist():
            shown.add_row(*("-" if value is None else str(value) for value in row.values()))
        Console(width=None if sys.stdout.isatty() else 200).print(shown)


def _distinct(names: Sequence[str]) -> list[str]:
    """Column names of which none comes twice: a, b, a_2."""
    counts: dict[str, int] = {}
    distinct = []
    for name in names:
        counts[name] = counts.get(name, 0) + 1
        distinct.append(name if counts[name] == 1 else f"{name}_{counts[name]}")
    return distinct


def _finite(value: object) -> object:
    """JSON has no numbers beside the finite ones: the others become null."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _with_text_lists(table: pa.Table) -> pa.Table:
    """CSV has no lists: write them as JSON."""
    for i, field in enumerate(table.schema):
        if pa.types.is_nested(field.type):
            text = [None if value is None else json.dumps(value) for value in table.column(i).to_pylist()]
            table = table.set_column(i, field.name, pa.array(text, pa.string()))
    return table

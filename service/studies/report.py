"""The folder that a study leaves: tables, figures, and a page that says how all of it was made."""

from __future__ import annotations

import csv
import os
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from t6gps.service.studies.arm_figures import FIGURES
from t6gps.service.studies.conduct import Finished, Trial, minutes
from t6gps.service.studies.declared import Study
from t6gps.service.training.evaluation import EVALUATED
from t6gps.service.views import run_figures
from t6gps.storage import durable, tables

Row = dict[str, Any]
ITERATION_COLUMNS = (
    "iteration",
    "cost",
    "forward_speed_m_per_s",
    "stuck_share_by_distance",
    "stuck_share",
    "waypoints_per_episode",
    "segments",
    "classes",
    "modes",
    "residual",
    "predicted_cost_change",
    "action_change_m",
)
MEANING = {
    "speed_over_winch_speed": ("over winch speed", 2, 1),
    "bar_lengths_per_s": ("bar lengths per s", 3, 1),
    "cost_of_transport": ("cost of transport", 2, 1),
    "slip_per_metre": ("slip (m per m)", 2, 1),
    "sunk_cable_share": ("a cable in the ground (%)", 1, 100),
}
"""What tables say of a speed: heading, digits and factor."""
DURATIONS = ("segmenting_s", "fitting_s", "backward_pass_s", "supervised_s")


def write(out: Path, name: str, study: Study, command: Sequence[str], finished: Sequence[Finished]) -> list[Path]:
    """Write the study's folder and return its files, the page first."""
    out.mkdir(parents=True, exist_ok=True)
    arms = arm_rows(finished)
    learners = any(outcome.trial.declared.baseline is None for outcome in finished)
    drawn = ("evaluations", *(["learning"] if learners else []), *study.figures)
    pictures = [run_figures.save(FIGURES[figure](finished), out / f"{figure}.png") for figure in drawn]
    written = {
        "README.md": _page(name, study, command, finished, arms, pictures),
        "table.md": markdown(arms),
    }
    for file, text in written.items():
        durable.hidden(out / file).write_text(text, encoding="utf-8")
        durable.publish(out / file)
    sheets = {"table.csv": arms, "runs.csv": run_rows(finished)}
    if learners:
        sheets["iterations.csv"] = iteration_rows(finished)
    if any(outcome.curve for outcome in finished):
        sheets["curves.csv"] = curve_rows(finished)
    if study.conditions:
        sheets["conditions.csv"] = condition_rows(finished)
    for file, rows in sheets.items():
        _write_csv(out / file, rows)
    return [*(out / file for file in (*written, *sheets)), *pictures]


def run_rows(finished: Sequence[Finished]) -> list[Row]:
    """One row per run: its arm and seed, the steps that it sampled, and its evaluation.

    The steps of a baseline are those that it was allowed.
    """
    rows = []
    for outcome in finished:
        iterations = tables.read(outcome.run, "iterations").sort_by("iteration").to_pylist()
        evaluated = {name: estimate.mean for name, estimate in outcome.evaluation.estimates().items()}
        rows.append(
            {
                "run": outcome.run.name,
                "arm": outcome.trial.arm,
                "seed": outcome.trial.seed,
                "steps": sum(row["steps"] for row in iterations) if iterations else outcome.trial.training_steps,
                **evaluated,
                "modes": iterations[-1]["modes"] if iterations else None,
                "learning_s": sum(row[key] for row in iterations for key in DURATIONS) if iterations else None,
                "wall_s": outcome.origin.wall_s,
                "commits": " ".join(outcome.origin.commits),
            }
        )
    return rows


def arm_rows(finished: Sequence[Finished]) -> list[Row]:
    """One row per arm: mean over its seeds of each quantity, and the standard deviation between seeds."""
    rows = run_rows(finished)
    result = []
    for arm in dict.fromkeys(row["arm"] for row in rows):
        seeds = [row for row in rows if row["arm"] == arm]
        summary: Row = {"arm": arm, "seeds": len(seeds)}
        summary["steps"] = round(np.mean([row["steps"] for row in seeds]))
        summary |= spread_of(seeds)
        for key in ("modes", "learning_s", "wall_s"):
            known = [row[key] for row in seeds if row[key] is not None]
            summary[key] = float(np.mean(known)) if known else None
        result.append(summary)
    return result


def iteration_rows(finished: Sequence[Finished]) -> list[Row]:
    """One row per run and iteration, from the samples with exploration noise."""
    return [
        {"run": outcome.run.name, "arm": outcome.trial.arm, "seed": outcome.trial.seed, **row}
        for outcome in finished
        for row in tables.read(outcome.run, "iterations", list(ITERATION_COLUMNS)).sort_by("iteration").to_pylist()
    ]


def curve_rows(finished: Sequence[Finished]) -> list[Row]:
    """One row per rival's run and mark: steps, seconds by the clock and of its thread, and the evaluation there."""
    return [
        {
            "run": outcome.run.name,
            "arm": outcome.trial.arm,
            "seed": outcome.trial.seed,
            "steps": point.steps,
            "wall_s": point.wall_s,
            "cpu_s": point.cpu_s,
            **{name: estimate.mean for name, estimate in point.evaluation.estimates().items()},
        }
        for outcome in finished
        for point in outcome.curve
    ]


def curve_table(finished: Sequence[Finished]) -> str:
    """Markdown table of rivals and marks: mean +- standard deviation between seeds, and mean seconds of training."""
    groups: dict[tuple[str, int], list[Row]] = {}
    for row in curve_rows(finished):
        groups.setdefault((row["arm"], row["steps"]), []).append(row)
    lines = [
        "| arm | seeds | steps | speed to the waypoint (m/s) | stuck: below 5 cm in 1 s (%) | training (s) |",
        "|---|---|---|---|---|---|",
    ]
    for (arm, steps), rows in groups.items():
        spread = spread_of(rows)
        speed, stuck = _spread(spread, "forward_speed_m_per_s", 3), _spread(spread, "stuck_share_by_distance", 1, 100)
        wall_s = np.mean([row["wall_s"] for row in rows])
        lines.append(f"| {arm} | {len(rows)} | {steps:,} | {speed} | {stuck} | {wall_s:,.0f} |")
    return "\n".join(lines) + "\n"


def condition_rows(finished: Sequence[Finished]) -> list[Row]:
    """One row per run and condition, the run's own world first."""
    return [
        {
            "run": outcome.run.name,
            "arm": outcome.trial.arm,
            "seed": outcome.trial.seed,
            "condition": condition,
            **{name: estimate.mean for name, estimate in result.estimates().items()},
        }
        for outcome in finished
        for condition, result in {"as trained": outcome.evaluation, **outcome.conditions}.items()
    ]


def condition_table(finished: Sequence[Finished]) -> str:
    """Markdown table of arms and conditions: mean +- standard deviation between seeds."""
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in condition_rows(finished):
        groups.setdefault((row["arm"], row["condition"]), []).append(row)
    lines = [
        f"| arm | condition | speed to the waypoint (m/s) | {_meanings()} | stuck: below 5 cm in 1 s (%) | cost |",
        "|---" * (5 + len(MEANING)) + "|",
    ]
    for (arm, condition), rows in groups.items():
        spread = spread_of(rows)
        last = (_spread(spread, "stuck_share_by_distance", 1, 100), _spread(spread, "cost", 3))
        cells = (_spread(spread, "forward_speed_m_per_s", 3), *_meaning(spread), *last)
        lines.append(f"| {arm} | {condition} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def spread_of(rows: Sequence[Row]) -> Row:
    """Mean of each evaluated quantity and, from two runs on, its standard deviation."""
    summary: Row = {}
    for key in EVALUATED:
        values = np.array([row[key] for row in rows if row[key] is not None])
        summary[key] = float(values.mean()) if len(values) else None
        summary[f"{key}_deviation"] = float(values.std(ddof=1)) if len(values) > 1 else None
    return summary


def _write_csv(path: Path, rows: Sequence[Row]) -> None:
    with durable.hidden(path).open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    durable.publish(path)


def markdown(arms: Sequence[Row]) -> str:
    """The table of arms: noise-free policies, mean +- standard deviation between seeds."""
    lines = [
        f"| arm | seeds | steps | speed to the waypoint (m/s) | {_meanings()} | waypoints per episode "
        "| stuck: below 5 cm in 1 s (%) | below 0.05 m/s (%) | cost | modes | learning (s) |",
        "|---" * (10 + len(MEANING)) + "|",
    ]
    for row in arms:
        cells = [
            row["arm"],
            str(row["seeds"]),
            f"{row['steps']:,}",
            _spread(row, "forward_speed_m_per_s", 3),
            *_meaning(row),
            _spread(row, "waypoints_per_episode", 2),
            _spread(row, "stuck_share_by_distance", 1, 100),
            _spread(row, "stuck_share_by_speed", 1, 100),
            _spread(row, "cost", 3),
            "-" if row["modes"] is None else f"{row['modes']:.2f}",
            "-" if row["learning_s"] is None else f"{row['learning_s']:.0f}",
        ]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def _meanings() -> str:
    return " | ".join(heading for heading, _, _ in MEANING.values())


def _meaning(row: Row) -> list[str]:
    """The cells of MEANING."""
    return [_spread(row, key, digits, factor) for key, (_, digits, factor) in MEANING.items()]


def _spread(row: Row, key: str, digits: int, factor: float = 1.0) -> str:
    if row[key] is None:
        return "-"
    mean, deviation = f"{factor * row[key]:.{digits}f}", row[f"{key}_deviation"]
    return mean if deviation is None else f"{mean} +- {factor * deviation:.{digits}f}"


def _page(
    name: str,
    study: Study,
    command: Sequence[str],
    finished: Sequence[Finished],
    arms: Sequence[Row],
    pictures: Sequence[Path],
) -> str:
    trials = [outcome.trial for outcome in finished]
    wall_s = sum(outcome.origin.wall_s or 0.0 for outcome in finished)
    commits = sorted({commit for outcome in finished for commit in outcome.origin.commits})
    seeds = sorted({trial.seed for trial in trials})
    evaluation_n = trials[0].config.run.evaluation_episodes
    return "\n".join(
        [
            f"# Study `{name}`",
            "",
            study.question,
            "",
            f"    {shlex.join(command)}",
            "",
            f"- seeds {', '.join(map(str, seeds))}; commit {', '.join(commits)}",
            f"- {len(finished)} runs in {minutes(wall_s)} of wall time on a machine with {os.cpu_count()} cores",
            f"- evaluation: noise-free policy, {evaluation_n} episodes on seeds that training never used",
            "",
            "## Result",
            "",
            "Noise-free policies, mean +- standard deviation between seeds; modes per class step of the last",
            "iteration; seconds of learning in a run.",
            "",
            markdown(arms),
            "`table.csv` holds the same, `runs.csv` each run, `iterations.csv` the samples of each iteration.",
            "",
            *(["Along the training:", "", curve_table(finished)] if any(each.curve for each in finished) else []),
            *(["Under other conditions:", "", condition_table(finished)] if study.conditions else []),
            *(line for picture in pictures for line in (f"![{picture.stem}]({picture.name})", "")),
            "## Runs",
            "",
            "Each is an ordinary run that `t6gps show`, `query` and `render` open; these commands make the same data:",
            "",
            *(f"    {shlex.join(train_command(trial))}" for trial in trials if trial.declared.baseline is None),
            "",
        ]
    )


def train_command(trial: Trial) -> list[str]:
    """The command that makes the data of a trial on its own."""
    return ["t6gps", "train", trial.declared.preset, "--run", trial.name, *(f"--set={key}" for key in trial.settings)]

"""The command line `t6gps`. Results go to stdout, progress and messages to stderr; bad input exits with 2.

What is slow to import (ray, torch, matplotlib) is imported by the commands that need it, so that the others answer
at once.
"""

from __future__ import annotations

import json
import shlex
import sys
from contextlib import closing
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import pyarrow.compute as pc
import typer

from t6gps.service import config as configuration
from t6gps.service.bench import registry as benchmarks
from t6gps.service.cli import live
from t6gps.service.cli.live import DEFAULT_ROOT, Json, Root, RunName
from t6gps.service.studies import declared
from t6gps.service.studies.declared import Scale
from t6gps.service.training import evaluation, session
from t6gps.service.training.session import Engine
from t6gps.service.views import terminal
from t6gps.service.views.diagnosis import diagnose
from t6gps.service.views.terminal import console
from t6gps.storage import catalog, tables
from t6gps.storage import query as sql_query
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, RunError, T6GpsError

app = typer.Typer(no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False)

EXIT_BAD_INPUT, EXIT_INTERRUPTED = 2, 130
EVALUATION_SECTIONS = ("robot.", "task.", "terrain.", "randomisation.", "run.steps", "run.workers")
EXPORT_SECTIONS = ("robot.", "terrain.")

Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, e.g. robot.friction=0.7.")
]
Serial = Annotated[bool, typer.Option("--serial", help="Run in this process, without Ray; same data.")]
Workers = Annotated[int | None, typer.Option("--workers", help="Rollout workers (changes the speed only).")]
Autoscale = Annotated[
    str | None, typer.Option("--autoscale", metavar="MIN:MAX", help="Keep workers between, by backlog and free CPUs.")
]


class ExportFormat(StrEnum):
    """Formats in which the robot leaves."""

    MJCF = "mjcf"


class QueryFormat(StrEnum):
    """Formats of a query's result."""

    TABLE = "table"
    CSV = "csv"
    JSON = "json"
    ARROW = "arrow"


def main() -> None:
    """Entry point of the command."""
    try:
        app()
    except T6GpsError as error:
        message = str(error)
    except OSError as error:
        message = (
            f"{error.filename or 'the system'}: {error.strerror or error}; make room or give access, then try again"
        )
    else:
        return
    console.print(f"error: {message}", style="red", highlight=False, soft_wrap=True, markup=False)
    sys.exit(EXIT_BAD_INPUT)


@app.command()
def train(
    source: Annotated[str, typer.Argument(metavar="PRESET|FILE.toml", help="Preset name or TOML file.")],
    run_name: Annotated[str | None, typer.Option("--run", help="Name of the run; by default the preset's.")] = None,
    root: Root = DEFAULT_ROOT,
    workers: Workers = None,
    autoscale: Autoscale = None,
    serial: Serial = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted run.")] = False,
    overrides: Overrides = None,
) -> None:
    """Train a policy: sample, segment, fit, optimise, learn, and keep everything."""
    config = configuration.load(source, _with_workers(overrides, workers, autoscale))
    name = Path(source).stem if run_name is None else run_name
    if resume:
        this = catalog.open_run(root, name)
        session.check_unchanged(this, config, "repeat the run's settings, or start a new run with --run")
    else:
        this = catalog.create(root, _free_name(root, name) if run_name is None else name, config.to_json())
    try:
        result, pictures = session.complete(config, this, serial)
    except KeyboardInterrupt:
        console.print(
            f"stopped; everything sampled so far is kept. Go on with: {_again(this, source, root, overrides)}",
            highlight=False,
            soft_wrap=True,
        )
        raise typer.Exit(EXIT_INTERRUPTED) from None
    _print_learning(this)
    terminal.print_evaluation(result)
    live.say_what_is_left_out(this)
    _print_paths(this, pictures, root)


@app.command()
def study(
    name: Annotated[str, typer.Argument(metavar="NAME", help=f"One of: {', '.join(declared.STUDIES)}.")],
    scale: Annotated[Scale, typer.Option(help="quick: half an hour on two cores; paper: the paper's sizes.")] = (
        Scale.QUICK
    ),
    seeds: Annotated[int | None, typer.Option(min=1, help="Training seeds of each arm, from 0 on.")] = None,
    arms: Annotated[str, typer.Option(metavar="PATTERN", help="Only arms of such names, e.g. '*-fast'.")] = "*",
    root: Root = DEFAULT_ROOT,
    out: Annotated[Path | None, typer.Option(help="Folder of the result; by default studies/NAME-SCALE.")] = None,
    workers: Workers = None,
    serial: Serial = False,
    overrides: Overrides = None,
) -> None:
    """Compare settings over seeds; run it again to go on after an interruption."""
    from t6gps.service.studies import conduct as conducting

    chosen = declared.find(name)
    planned = conducting.trials(name, chosen, scale, seeds, _with_workers(overrides, workers), arms)
    command = _study_command(name, scale, seeds, arms, root, out, overrides)
    try:
        finished = conducting.conduct(planned, root, name, chosen.conditions, serial)
    except KeyboardInterrupt:
        console.print(
            f"stopped; everything sampled so far is kept. Go on with: {shlex.join(command)}",
            highlight=False,
            soft_wrap=True,
        )
        raise typer.Exit(EXIT_INTERRUPTED) from None
    from t6gps.service.studies import report

    files = report.write(out or Path("studies") / f"{name}-{scale}", name, chosen, command, finished)
    terminal.print_rows(f"Study {name}, {scale}", report.arm_rows(finished), terminal.ARM_COLUMNS)
    typer.echo("\n".join(str(file) for file in files))


@app.command(name="eval")
def evaluate(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    episodes: Annotated[int, typer.Option(min=2, help="Noise-free episodes.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts and waypoints; never one of training.")] = 1,
    terrain_seed: Annotated[int | None, typer.Option(min=0, help="Seed of the ground alone.")] = None,
    overrides: Overrides = None,
    workers: Workers = None,
    serial: Serial = False,
    engine: Annotated[Engine, typer.Option(help="mujoco cross-checks, as with --serial.")] = Engine.BULLET,
    as_json: Json = False,
) -> None:
    """Evaluate a run's newest policy without noise on unseen seeds."""
    this = catalog.open_run(root, run_name)
    _check_keys(overrides, "eval", EVALUATION_SECTIONS, "the policy is trained already")
    config = configuration.parse(this.config_path.read_text(), _with_workers(overrides, workers))
    with closing(session.restored(config, this, serial, engine)) as executor:
        result = session.evaluated(config, executor, episodes, seed, terrain_seed)
    if as_json:
        typer.echo(json.dumps(result))
    else:
        terminal.print_evaluation(result)


@app.command()
def runs(root: Root = DEFAULT_ROOT) -> None:
    """List the runs."""
    if not root.is_dir():
        raise RunError(f"there is no folder {root} that could hold runs; train a first one, or give another --root")
    rows = []
    for this in catalog.list_runs(root):
        last = tables.read(this, "iterations").sort_by("iteration").to_pylist()[-1:]
        done = len(last) and last[0]["iteration"] + 1
        wanted = configuration.parse(this.config_path.read_text()).run.iterations
        rows.append(
            {
                "run": this.name,
                "iterations": f"{done} of {wanted}",
                "cost": last[0]["cost"] if last else None,
                "forward_speed_m_per_s": last[0]["forward_speed_m_per_s"] if last else None,
            }
        )
    columns = {"run": ("run", "{}"), "iterations": ("iterations", "{}")}
    columns |= {key: terminal.LEARNING_COLUMNS[key] for key in ("cost", "forward_speed_m_per_s")}
    terminal.print_rows(f"Runs in {root}", rows, columns)


@app.command()
def show(run_name: RunName, root: Root = DEFAULT_ROOT) -> None:
    """Show a run: learning curve, segment classes of the last iteration, diagnosis, evaluation, files."""
    this = catalog.open_run(root, run_name)
    if not tables.committed_iterations(this):
        typer.echo(f"run {run_name} has not finished an iteration yet")
        return
    _print_learning(this)
    classes = tables.read(this, "classes").to_pylist()
    last = max((row["iteration"] for row in classes), default=-1)
    rows = [row | {"kind": ("Delta", "Lambda")[row["kind"]]} for row in classes if row["iteration"] == last]
    terminal.print_rows(f"Segment classes of iteration {last}", rows, terminal.CLASS_COLUMNS)
    iterations = tables.read(this, "iterations").to_pylist()
    typer.echo("\n".join(["Diagnosis:", *(f"  {sentence}" for sentence in diagnose(iterations, classes)), ""]))
    result = evaluation.kept(this)
    if result:
        terminal.print_evaluation(result)
    _print_paths(this, sorted(this.figures.glob("*.png")), root)


@app.command()
def query(
    run_name: RunName,
    sql: Annotated[str, typer.Argument(metavar="SQL", help="One SELECT over frames, episodes, iterations, classes.")],
    root: Root = DEFAULT_ROOT,
    form: Annotated[QueryFormat, typer.Option("--format", help="How to print the result.")] = QueryFormat.TABLE,
) -> None:
    """Query a run's stored trajectories with SQL."""
    terminal.write_table(sql_query.query(catalog.open_run(root, run_name), sql), form.value)


@app.command()
def render(
    run_name: RunName,
    episode: Annotated[int, typer.Argument(min=0, help="Episode id (see the table `episodes`).")],
    out: Annotated[Path, typer.Option("--out", help="FILE.png or FILE.mp4.")],
    root: Root = DEFAULT_ROOT,
    step: Annotated[int | None, typer.Option(min=0, help="Control step of a still.")] = None,
    strip: Annotated[int | None, typer.Option(min=1, help="Snapshots in a strip.")] = None,
) -> None:
    """Draw a stored episode from its recorded states: a still, a strip of snapshots, or a film."""
    from t6gps.workers.ground.ground import ground
    from t6gps.workers.pictures import render as rendering

    this = catalog.open_run(root, run_name)
    frames = tables.episode_frames(this, episode)
    row = tables.read(this, "episodes", filter=pc.field("episode_id") == episode).to_pylist()[0]
    config = configuration.parse(this.config_path.read_text())
    terrain = ground(config.terrain, row["terrain_seed"], row["terrain_difficulty"])
    with terminal.task("rendering") as progress:
        rendering.render(frames, terrain, out, step=step, strip=strip, progress=progress)
    typer.echo(out)


@app.command()
def export(
    form: Annotated[ExportFormat, typer.Argument(metavar="mjcf", help="MuJoCo's model format.")],
    out: Annotated[Path, typer.Argument(metavar="FILE.xml", help="File to write.")],
    terrain_seed: Annotated[int, typer.Option(min=0, help="Seed of rough ground (--set terrain.difficulty=1).")] = 0,
    root: Root = DEFAULT_ROOT,
    overrides: Overrides = None,
) -> None:
    """Write the robot and its ground as a model for other tools."""
    from t6gps.workers.ground.ground import ground
    from t6gps.workers.physics.mjcf import to_mjcf

    _check_keys(overrides, f"export {form.value}", EXPORT_SECTIONS, "the model has only a robot and its ground")
    config = configuration.parse("{}", overrides or [], "--set")
    text = to_mjcf(config.robot, ground(config.terrain, terrain_seed, config.terrain.difficulty))
    try:
        out.write_text(text)
    except OSError as error:
        raise ConfigError(f"cannot write {out}: {error.strerror}; name a file in an existing folder") from None
    typer.echo(out)


@app.command()
def bench(
    name: Annotated[str, typer.Argument(help=f"One of: {', '.join(benchmarks.BENCHMARKS)}.")],
    root: Root = DEFAULT_ROOT,
    seconds: Annotated[float | None, typer.Option(help="pool: seconds of each measurement; 30 by default.")] = None,
    rounds: Annotated[int | None, typer.Option(help="pool: measurements of each contender; 5 by default.")] = None,
    as_json: Json = False,
) -> None:
    """Measure speed, each figure beside a reference of the same run."""
    sizes = {"seconds": seconds, "rounds": rounds}
    result = benchmarks.measure(name, **{key: value for key, value in sizes.items() if value is not None})
    if as_json:
        typer.echo(json.dumps(result))
    else:
        rows = [{"key": key, "value": value} for key, value in result["results"].items()]
        title = f"{name} at commit {result['commit']}, {result['threads']} thread(s)"
        terminal.print_rows(title, rows, {"key": ("key", "{}"), "value": ("value", "{:.4g}")})
        typer.echo("".join(f"{note}\n" for note in result["notes"]), nl=False)


live.add_to(app)


def _check_keys(overrides: list[str] | None, command: str, allowed: tuple[str, ...], reason: str) -> None:
    for override in overrides or []:
        if not override.startswith(allowed):
            raise ConfigError(
                f"{command} cannot change {override.partition('=')[0]}: {reason}; "
                f"allowed: keys that start with {', '.join(allowed)}"
            )


def _with_workers(overrides: list[str] | None, workers: int | None, autoscale: str | None = None) -> list[str]:
    wanted = [] if workers is None else [f"run.workers={workers}"]
    if autoscale is not None:
        least, colon, most = autoscale.partition(":")
        if not (colon and least.isdecimal() and most.isdecimal()):
            raise ConfigError(f"--autoscale takes MIN:MAX, found '{autoscale}'; for example --autoscale 1:8")
        wanted += [f"run.workers_min={least}", f"run.workers_max={most}"]
    return (overrides or []) + wanted


def _free_name(root: Path, name: str) -> str:
    """`name`, or the first of name-2, name-3, ... that no run has."""
    taken = {this.name for this in catalog.list_runs(root)}
    number = 2
    free = name
    while free in taken:
        free, number = f"{name}-{number}", number + 1
    return free


def _again(this: Run, source: str, root: Path, overrides: list[str] | None) -> str:
    parts = ["t6gps", "train", source, "--run", this.name, "--root", str(root), "--resume"]
    return shlex.join(parts + [f"--set={override}" for override in overrides or []])


def _study_command(
    name: str, scale: Scale, seeds: int | None, arms: str, root: Path, out: Path | None, overrides: list[str] | None
) -> list[str]:
    parts = ["t6gps", "study", name, "--scale", scale.value]
    parts += [] if seeds is None else ["--seeds", str(seeds)]
    parts += [] if arms == "*" else ["--arms", arms]
    parts += [] if root == DEFAULT_ROOT else ["--root", str(root)]
    parts += [] if out is None else ["--out", str(out)]
    return parts + [f"--set={override}" for override in overrides or []]


def _print_learning(this: Run) -> None:
    rows: list[dict[str, Any]] = tables.read(this, "iterations").sort_by("iteration").to_pylist()
    terminal.print_rows(f"Run {this.name}", rows, terminal.LEARNING_COLUMNS)


def _print_paths(this: Run, pictures: list[Path], root: Path) -> None:
    place = f" --root {shlex.quote(str(root))}" if root != DEFAULT_ROOT else ""
    lines = [
        f"dataset      {this.tables}",
        f"checkpoints  {this.checkpoints}",
        *(f"figure       {picture}" for picture in pictures),
        "",
        "Try next:",
        f"  t6gps eval {this.name} --episodes 40 --seed 7{place}",
        f'  t6gps query {this.name} "SELECT iteration, avg(forward_speed_m_per_s) AS m_per_s FROM episodes '
        f'GROUP BY iteration ORDER BY iteration"{place}',
        f"  t6gps render {this.name} 0 --out episode.mp4{place}",
    ]
    typer.echo("\n".join(lines))


if __name__ == "__main__":
    main()

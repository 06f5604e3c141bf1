"""The command line `t6gps`. Results go to stdout, progress and messages to stderr; bad input exits with 2.

This module has the commands that start something: train, study, eval, bench. `data` has those for what is stored,
`live` those for a run that is running, `launching` those for jobs. What is slow to import (ray, torch,
matplotlib) is imported by the commands that need it, so that the others answer at once.
"""

from __future__ import annotations

import logging
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import typer

from t6gps.service import advice, logs
from t6gps.service import config as configuration
from t6gps.service.bench import registry as benchmarks
from t6gps.service.cli import doctor, door, launching, live, policy, serving
from t6gps.service.cli.data import asking, care, export, figures, listing, pictures
from t6gps.service.cli.guide import completion, examples
from t6gps.service.cli.options import (
    DEFAULT_ROOT,
    Autoscale,
    Json,
    Overrides,
    Publish,
    Root,
    RunName,
    Serial,
    Server,
    Workers,
    with_workers,
)
from t6gps.service.logs import Role, Speaker
from t6gps.service.studies import declared
from t6gps.service.studies.declared import Scale
from t6gps.service.training import origin, publishing, session
from t6gps.service.training.session import Engine
from t6gps.service.views import terminal
from t6gps.storage import catalog
from t6gps.storage.catalog import Run
from t6gps.storage.errors import ConfigError, T6GpsError

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False)

EXIT_MISTAKE, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
_log = logging.getLogger(__name__)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command; `t6gps.__main__` has prepared the process, whose arguments are taken where none are given."""
    try:
        try:
            logs.begin(Speaker(logs.chosen()))
            app(arguments, prog_name=completion.PROGRAM)
        finally:
            sys.stdout.flush()  # a full disk is told of below
    except T6GpsError as error:
        message = str(error)
    except OSError as error:
        message = advice.sentence(error)
    except KeyboardInterrupt:  # before or after the command itself
        sys.exit(EXIT_INTERRUPTED)
    except Exception:  # a mistake of ours
        if not logs.as_json():
            raise
        _log.critical("the command has made a mistake; report it", exc_info=True)
        sys.exit(EXIT_MISTAKE)
    else:
        return
    terminal.say(message, logging.ERROR)
    sys.exit(EXIT_BAD_INPUT)


@app.command()
def train(
    source: Annotated[str, typer.Argument(metavar="PRESET|FILE.toml", help="Preset name or TOML file.")],
    run_name: Annotated[str | None, typer.Option("--run", help="Name of the run; by default the preset's.")] = None,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    workers: Workers = None,
    autoscale: Autoscale = None,
    serial: Serial = False,
    resume: Annotated[
        bool, typer.Option("--resume", help="Continue an interrupted run; start one that is not there yet.")
    ] = False,
    publish: Publish = None,
    overrides: Overrides = None,
) -> None:
    """Train a policy: sample, segment, fit, optimise, learn, and keep everything."""
    if server is not None and publish is not None:
        raise ConfigError(
            "--publish takes the keys of this machine, and a server's runs are trained where it is; leave out "
            f"--publish, and copy the run there with: t6gps cp RUN RUN --to {publish}"
        )
    if server is not None:
        serving.train_there(server, source, run_name, with_workers(overrides, workers, autoscale), serial, resume)
        return
    config = configuration.load(source, with_workers(overrides, workers, autoscale))
    logs.become(Role.SUPERVISOR, run_name)
    copies = publishing.target(publish)
    run = session.begin(config, root, run_name, Path(source).stem, resume, terminal.warn, copies)
    logs.become(Role.SUPERVISOR, run.name)
    try:
        with terminal.ProgressDisplay(config.run.iterations) as display:
            result = session.complete(config, run, serial, display, copies)
    except KeyboardInterrupt:
        if not run.path.exists():
            terminal.say("stopped before anything was sampled; nothing is left of the run")
            raise typer.Exit(EXIT_INTERRUPTED) from None
        _exit_interrupted(_train_command(run, source, root, publish, overrides))
    from t6gps.service.views import run_figures

    pictures = run_figures.draw(run, origin.configured(run))
    listing.print_learning(run)
    terminal.print_evaluation(result)
    live.name_quarantined(run)
    listing.print_paths(run, pictures, root)


@app.command()
def study(
    name: Annotated[str, typer.Argument(metavar="STUDY", help=f"One of: {', '.join(declared.STUDIES)}.")],
    scale: Annotated[Scale, typer.Option(help="quick: half an hour on two cores; paper: the paper's sizes.")] = (
        Scale.QUICK
    ),
    seeds: Annotated[int | None, typer.Option(min=1, help="Training seeds of each arm, from 0 on.")] = None,
    arms: Annotated[str, typer.Option(metavar="PATTERN", help="Only arms of such names, e.g. '*-fast'.")] = "*",
    root: Root = DEFAULT_ROOT,
    out: Annotated[Path | None, typer.Option(help="Folder of the result; by default studies/NAME-SCALE.")] = None,
    workers: Workers = None,
    serial: Serial = False,
    publish: Publish = None,
    overrides: Overrides = None,
) -> None:
    """Compare settings over seeds; run it again to resume it after an interruption."""
    from t6gps.service.studies import conduct as conducting

    chosen = declared.find(name)
    planned = conducting.trials(name, chosen, scale, seeds, with_workers(overrides, workers), arms)
    command = _study_command(name, scale, seeds, arms, root, out, overrides)
    copies, display = publishing.target(publish), terminal.StudyDisplay()
    try:
        finished = conducting.conduct(planned, root, name, chosen.conditions, serial, display, copies=copies)
    except KeyboardInterrupt:
        _exit_interrupted(command + ([] if publish is None else ["--publish", publish]))
    from t6gps.service.studies import report

    files = report.write(out or Path("studies") / f"{name}-{scale}", name, chosen, command, finished)
    terminal.print_rows(f"Study {name}, {scale}", report.arm_rows(finished), terminal.ARM_COLUMNS)
    typer.echo("\n".join(str(file) for file in files))


@app.command(name="eval")
def evaluate(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    episodes: Annotated[int, typer.Option(min=2, help="Noise-free episodes.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts and waypoints; never one of training.")] = 1,
    terrain_seed: Annotated[int | None, typer.Option(min=0, help="Seed of the ground alone.")] = None,
    version: Annotated[
        int | None, typer.Option("--policy", min=0, help="Version of the policy; by default the newest.")
    ] = None,
    no_keep: Annotated[bool, typer.Option("--no-keep", help="Leave the run's tables as they are.")] = False,
    overrides: Overrides = None,
    workers: Workers = None,
    serial: Serial = False,
    engine: Annotated[Engine, typer.Option(help="mujoco cross-checks, as with --serial.")] = Engine.BULLET,
    as_json: Json = False,
) -> None:
    """Evaluate a run's policy without noise on unseen seeds, and keep the episodes, but not for a server's run."""
    logs.become(Role.SUPERVISOR, run_name)
    with door.opened(root, server) as there, there.at_hand(run_name) as run:
        config = session.evaluation_config(run, with_workers(overrides, workers), terminal.warn)
        policy = there.policy(run_name, version)
        asked = session.Asked(episodes, seed, terrain_seed, policy.version, keep=server is None and not no_keep)
        with terminal.ProgressDisplay(config.run.iterations) as display:
            result, number = session.evaluate(run, config, asked, serial, engine, display, policy)
    if as_json:
        typer.echo(result.to_json())
    else:
        terminal.print_evaluation(result)
    if number is not None:
        terminal.say(f"kept as evaluation {number}: see the table evaluations, or t6gps render with --evaluation")


@app.command()
def bench(
    name: Annotated[str, typer.Argument(metavar="BENCHMARK", help=f"One of: {', '.join(benchmarks.BENCHMARKS)}.")],
    run_name: Annotated[str | None, typer.Argument(metavar="[RUN]", help="surrogate: the run to judge.")] = None,
    root: Root = DEFAULT_ROOT,
    seconds: Annotated[
        float | None, typer.Option(help="pool, server: seconds of each measurement; 30 by default.")
    ] = None,
    rounds: Annotated[
        int | None, typer.Option(help="pool, server, storage: measurements of each contender; 5 by default.")
    ] = None,
    iteration: Annotated[
        int | None, typer.Option(min=0, help="surrogate: by default the last that the backward pass led.")
    ] = None,
    pieces: Annotated[int | None, typer.Option(min=2, help="surrogate: of the branch test; 200 by default.")] = None,
    states: Annotated[int | None, typer.Option(min=2, help="surrogate: of the gradient test; 600 by default.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="surrogate: of what is drawn; 0 by default.")] = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Measure speed, each figure beside a reference of the same run; or what a run's learner promises (surrogate)."""
    options: dict[str, float | list[str] | None] = {
        "seconds": seconds,
        "rounds": rounds,
        "iteration": iteration,
        "pieces": pieces,
        "states": states,
        "seed": seed,
        "overrides": overrides,
    }
    chosen = {key: value for key, value in options.items() if value is not None}
    run = None if run_name is None else partial(catalog.open_run, root, run_name)
    measurement = benchmarks.measure(name, terminal.say, run, **chosen)
    if as_json:
        typer.echo(measurement.to_json())
        return
    rows = [{"key": key, "value": value} for key, value in measurement.results.items()]
    title = f"{name} at commit {measurement.provenance.commit}, {measurement.threads} thread(s)"
    terminal.print_rows(title, rows, {"key": ("key", "{}"), "value": ("value", "{:.4g}")})
    typer.echo("".join(f"{note}\n" for note in measurement.notes), nl=False)


for commands in (listing, asking, pictures, figures, export, care):
    commands.add_to(app)
live.add_to(app)
launching.add_to(app)
serving.add_to(app)
policy.add_to(app)
doctor.add_to(app)
examples.attach(app)


def _exit_interrupted(command: list[str]) -> NoReturn:
    """Say how to continue what Ctrl-C or SIGTERM has stopped, and exit."""
    terminal.say(f"stopped; everything sampled so far is kept. Resume with: {shlex.join(command)}")
    raise typer.Exit(EXIT_INTERRUPTED) from None


def _train_command(run: Run, source: str, root: Path, publish: str | None, overrides: list[str] | None) -> list[str]:
    parts = ["t6gps", "train", source, "--run", run.name, "--root", str(root), "--resume"]
    parts += [] if publish is None else ["--publish", publish]
    return parts + [f"--set={override}" for override in overrides or []]


def _study_command(
    name: str, scale: Scale, seeds: int | None, arms: str, root: Path, out: Path | None, overrides: list[str] | None
) -> list[str]:
    parts = ["t6gps", "study", name, "--scale", scale.value]
    parts += [] if seeds is None else ["--seeds", str(seeds)]
    parts += [] if arms == "*" else ["--arms", arms]
    parts += [] if root == DEFAULT_ROOT else ["--root", str(root)]
    parts += [] if out is None else ["--out", str(out)]
    return parts + [f"--set={override}" for override in overrides or []]

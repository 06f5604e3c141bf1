"""The commands for policies outside of runs: `policy export` writes a file, `policy run` drives a simulator by it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from t6gps.service.cli import door
from t6gps.service.cli.data import pictures
from t6gps.service.cli.options import DEFAULT_ROOT, Json, Overrides, Root, RunName, Server
from t6gps.service.policies import files
from t6gps.service.policies.files import Format
from t6gps.service.training import origin, session
from t6gps.service.views import terminal

if TYPE_CHECKING:
    from t6gps.storage.records import Episode

policy = typer.Typer(no_args_is_help=True, help="Policies as files, for robots and other programs.")


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    app.add_typer(policy, name="policy")


@policy.command()
def export(
    run_name: RunName,
    form: Annotated[Format, typer.Option("--format", help="c is one header of C99.")],
    version: Annotated[
        int | None, typer.Option("--version", min=0, help="Version of the policy; by default the newest.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="File to write; by default RUN-VERSION and a suffix.")
    ] = None,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
) -> None:
    """Write a policy as a function from what a robot measures to the commands of its cables."""
    with door.opened(root, server) as there, there.at_hand(run_name) as run:
        session.tell_changes(run, terminal.warn)
        chosen = there.policy(run_name, version)
        file = files.write(form, out, run.name, origin.configured(run), origin.kept(run), chosen)
    typer.echo(file)
    if form is Format.C:
        terminal.say(f'call it: #include "{file.name}" in one C file; its first lines show how; link with -lm')
    terminal.say(f"drive the simulator with it: t6gps policy run {file}")


@policy.command()
def run(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A policy that `policy export` has written.")],
    episodes: Annotated[int, typer.Option(min=2, help="Noise-free episodes.")] = 40,
    seed: Annotated[int, typer.Option(min=0, help="Seed of starts and waypoints, as of `eval`.")] = 1,
    terrain_seed: Annotated[int | None, typer.Option(min=0, help="Seed of the ground alone.")] = None,
    render: Annotated[
        Path | None, typer.Option("--render", metavar="FILE", help="Film (.mp4) or picture (.png) of the first.")
    ] = None,
    overrides: Overrides = None,
    as_json: Json = False,
) -> None:
    """Drive the simulator by a policy's file alone, in the world that it was trained in, and report as `eval` does."""
    from t6gps.service.policies import driving
    from t6gps.workers.pictures.render import check_place

    driver = files.opened(file)
    config = driving.world(driver.description, overrides or [], file)
    if render is not None:
        check_place(render)
    first: list[Episode] = []

    def keep(episode: Episode) -> None:
        if not first:
            first.append(episode)

    with terminal.task("driving") as progress:
        result = driving.drive(driver, config, episodes, seed, terrain_seed, keep, progress)
    if as_json:
        typer.echo(result.to_json())
    else:
        terminal.print_evaluation(result)
    if render is not None:
        pictures.draw(config, first[0], render)
        typer.echo(render, err=as_json)

"""The command `figures`: the paper's figures for a run, of noise-free episodes as long as the paper's."""

from __future__ import annotations

import json
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import pyarrow as pa
import pyarrow.compute as pc
import typer

from t6gps.service import logs
from t6gps.service.cli import door
from t6gps.service.cli.data.pictures import EvaluationId
from t6gps.service.cli.door import Door
from t6gps.service.cli.options import DEFAULT_ROOT, Root, RunName, Server
from t6gps.service.logs import Role
from t6gps.service.training import evaluation_records, origin, session
from t6gps.service.training.session import Asked, Engine
from t6gps.service.views import terminal
from t6gps.storage.catalog import Run
from t6gps.storage.errors import RunError
from t6gps.storage.objects import place

if TYPE_CHECKING:
    from t6gps.service.views.paper.material import Material

STEPS_N = 900
"""Control steps of an episode, 1.5 minutes as in the paper (Sec. V-C)."""
EPISODES_N, SEED = 8, 1
"""Of an evaluation that is made for figures."""


def add_to(app: typer.Typer) -> None:
    """Make the command part of `t6gps`."""
    app.command()(figures)


def figures(
    run_name: RunName,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
    evaluation_id: EvaluationId = None,
    episode: Annotated[
        int | None, typer.Option("--episode", min=0, help="Episode to show; by default that of median forward speed.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the files; by default figures/RUN.")] = None,
) -> None:
    """Draw the paper's figures for a run, of noise-free episodes of 900 steps, which are made where there are none."""
    from t6gps.service.views.paper import drawing

    with door.opened(root, server) as there, there.at_hand(run_name) as run:
        session.tell_changes(run, terminal.warn)
        iterations = there.table(run_name, "iterations").sort_by("iteration")
        if not iterations.num_rows:
            raise RunError(f"run {run_name} has no iteration to draw yet; let it finish one")
        if evaluation_id is None:
            version = iterations.num_rows
            evaluation_id = _kept(there, run_name, version)
        if evaluation_id is None:
            evaluation_id = _made(there, run, version, far=server is not None)
        material = gathered(there, run, iterations, evaluation_id, episode)
    with terminal.task("drawing") as progress:
        drawn = drawing.draw(material, out or Path("figures") / run_name, progress)
    for name, reason in drawn.left_out.items():
        terminal.say(f"left out: {name}; {reason}")
    typer.echo("\n".join(map(str, drawn.files)))


def _kept(there: Door, run: str, version: int) -> int | None:
    """The newest evaluation of a policy, in the run's own world, that has episodes as long as the paper's."""
    episodes = there.table(run, "evaluation_episodes")
    long = set(episodes.filter(pc.field("steps") >= STEPS_N)["evaluation_id"].to_pylist())
    found = [
        int(row["evaluation_id"])
        for row in there.table(run, "evaluations").to_pylist()
        if row["evaluation_id"] in long
        and (row["policy_version"], row["engine"]) == (version, Engine.BULLET.value)
        and json.loads(row["settings"]).keys() <= {"run.steps"}
    ]
    return max(found, default=None)


def _made(there: Door, run: Run, version: int, far: bool) -> int:
    """Make such an evaluation and keep it; its number. RunError where the run takes none."""
    lacking = f"run {run.name} keeps no noise-free episodes of {STEPS_N} steps of its policy {version}"
    if far or place.is_object(run.path):
        short = there.table(run.name, "evaluations")["evaluation_id"].to_pylist()
        other = f"; or draw shorter ones with --evaluation {max(short)}" if short else ""
        raise RunError(
            f"{lacking}, and none can be kept from here; make them where the run was trained, by "
            f"t6gps eval {run.name} --episodes {EPISODES_N} --set run.steps={STEPS_N}{other}"
        )
    terminal.say(f"{lacking}; {EPISODES_N} are made now and kept as an evaluation")
    logs.become(Role.SUPERVISOR, run.name)
    config = origin.configured(run, [f"run.steps={STEPS_N}"])
    with terminal.ProgressDisplay(config.run.iterations) as display:
        asked = Asked(EPISODES_N, SEED, version=version)
        _, number = session.evaluate(run, config, asked, True, Engine.BULLET, display)
    assert number is not None
    terminal.say(f"kept as evaluation {number}")
    return number


def gathered(there: Door, run: Run, iterations: pa.Table, evaluation_id: int, episode: int | None) -> Material:
    """What the figures are drawn from. DataError for an evaluation or an episode that is not there."""
    from t6gps.service.views import run_figures
    from t6gps.service.views.paper.material import FRAME_COLUMNS, MODEL_COLUMNS, Material

    evaluations = there.table(run.name, "evaluations")
    config = evaluation_records.world(run, evaluations, evaluation_id)
    of = pc.field("evaluation_id") == evaluation_id
    episodes = there.table(run.name, "evaluation_episodes").filter(of).sort_by("episode_id")
    shown = episodes["episode_id"][run_figures.typical(episodes)].as_py() if episode is None else episode
    newest = "WHERE iteration = (SELECT max(iteration) FROM"
    return Material(
        run=run.name,
        config=config,
        iterations=iterations,
        sampled=_rows(there, run.name, "frames", ["forward_speed_m_per_s"], f"{newest} frames)"),
        models=_rows(there, run.name, "models", MODEL_COLUMNS, f"{newest} models) ORDER BY bin, step, mode"),
        evaluation=evaluations.filter(of),
        episodes=episodes,
        frames=_rows(
            there,
            run.name,
            "evaluation_frames",
            FRAME_COLUMNS,
            f"WHERE evaluation_id = {evaluation_id} ORDER BY episode_id, step",
        ),
        shown=there.episode(run.name, shown, evaluation_id),
    )


def _rows(there: Door, run: str, table: str, columns: Sequence[str], chosen: str) -> pa.Table:
    """Columns of the rows of a table that the rest of a SELECT chooses."""
    sink = BytesIO()
    there.write(run, f"SELECT {', '.join(columns)} FROM {table} {chosen}", {}, "arrow", sink, terminal.warn)
    return pa.ipc.open_stream(sink.getvalue()).read_all()

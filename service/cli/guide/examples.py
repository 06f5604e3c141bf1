"""Examples of every command, which end its `--help`."""

from __future__ import annotations

import typer

EXAMPLES: dict[str, tuple[str, ...]] = {
    "": ("t6gps doctor", "t6gps train flat-quick", "t6gps show flat-quick"),
    "train": (
        "t6gps train flat-quick",
        "t6gps train rough --run slow --set robot.winch_speed_m_per_s=0.35 --workers 8",
        "t6gps train rough --run slow --set robot.winch_speed_m_per_s=0.35 --resume",
    ),
    "study": ("t6gps study horizon", "t6gps study surrogate --scale paper --seeds 3 --arms 'nodes*'"),
    "eval": (
        "t6gps eval rough-quick --episodes 80 --seed 7",
        "t6gps eval flat-quick --set terrain.difficulty=0.5 --json",
        "t6gps eval flat-quick --engine mujoco --no-keep",
    ),
    "bench": ("t6gps bench physics", "t6gps bench pool --seconds 10 --rounds 3", "t6gps bench surrogate rough-quick"),
    "runs": ("t6gps runs", "t6gps runs --size --root s3-copies"),
    "show": ("t6gps show rough-quick",),
    "query": (
        't6gps query rough-quick "SELECT iteration, cost FROM iterations"',
        """t6gps query 'rough-*' "SELECT * FROM stuck" --format csv""",
        "t6gps query '*' --file question.sql --param least=0.5 --out answer.parquet",
    ),
    "schema": ("t6gps schema", "t6gps schema stuck"),
    "render": (
        "t6gps render rough-quick 290 --out episode.mp4",
        "t6gps render rough-quick 290 --out still.png --step 20",
        "t6gps render rough-quick 1 --evaluation 0 --out strip.png --strip 6",
    ),
    "view": (
        "t6gps view rough-quick 3 7",
        "t6gps view rough-quick --pick best:1,worst:1",
        "t6gps view rough-quick 3 --out episode.rrd",
    ),
    "figures": ("t6gps figures rough-quick", "t6gps figures rough-quick --evaluation 0 --episode 3 --out drawn"),
    "export": ("t6gps export lerobot rolling --run 'rough-*'", "t6gps export mjcf superball.xml"),
    "export mjcf": (
        "t6gps export mjcf superball.xml",
        "t6gps export mjcf rough.xml --set terrain.difficulty=1 --terrain-seed 4",
    ),
    "export lerobot": ("t6gps export lerobot rolling --run 'rough-*' --license CC-BY-4.0",),
    "export minari": ("t6gps export minari rolling --run rough-quick --where 'iteration >= 5'",),
    "export rllib": ("t6gps export rllib rolling --run rough-quick",),
    "export parquet": ("t6gps export parquet rolling --where 'episodes.cost < 3'",),
    "policy": (
        "t6gps policy export rough-quick --format onnx --out walker.onnx",
        "t6gps policy run walker.onnx --episodes 8",
    ),
    "policy export": (
        "t6gps policy export rough-quick --format c",
        "t6gps policy export rough-quick --version 7 --format onnx --out walker.onnx",
    ),
    "policy run": (
        "t6gps policy run walker.onnx --episodes 8 --seed 7",
        "t6gps policy run walker.onnx --set robot.friction=0.5 --json",
    ),
    "verify": ("t6gps verify", "t6gps verify rough-quick flat-quick --json"),
    "repair": ("t6gps repair rough-quick", "t6gps repair rough-quick --from copies/rough-quick"),
    "cp": ("t6gps cp rough-quick before", "t6gps cp rough-quick rough-quick --to s3://lab/runs"),
    "mv": ("t6gps mv flat-quick walker", "t6gps mv flat-quick flat-quick --to archive"),
    "rm": ("t6gps rm flat-quick", "t6gps rm flat-quick --yes"),
    "scale": ("t6gps scale rough 6", "t6gps scale rough 0"),
    "pause": ("t6gps pause rough",),
    "unpause": ("t6gps unpause rough",),
    "stop": ("t6gps stop rough", "t6gps stop rough --deadline 120"),
    "status": ("t6gps status rough", "t6gps status rough --json"),
    "events": ("t6gps events rough", "t6gps events rough -f"),
    "replay": ("t6gps replay runs/rough/bundles/episode-17.json",),
    "submit": (
        "t6gps submit rough",
        "t6gps submit rough --to slurm --target cluster.toml --seeds 5",
        "t6gps submit rough --to k8s --dry-run",
    ),
    "jobs": ("t6gps jobs",),
    "logs": ("t6gps logs rough", "t6gps logs -f rough"),
    "fetch": ("t6gps fetch rough", "t6gps fetch rough --to runs --run rough-home"),
    "serve": (
        "t6gps serve",
        "t6gps serve --host 0.0.0.0 --tls-cert chain.pem --tls-key key.pem",
    ),
    "token": ("t6gps token create me --scope operate", "t6gps token list"),
    "token create": ("t6gps token create me --scope operate", "t6gps token create dashboard --days 7"),
    "token list": ("t6gps token list",),
    "token revoke": ("t6gps token revoke dashboard",),
    "doctor": ("t6gps doctor", "t6gps doctor --workers 8 --root runs"),
}
"""Examples of a command by the words that call it, of the program itself by none."""


def attach(app: typer.Typer) -> None:
    """Let the help of a program and of its commands end with their examples."""
    app.info.epilog = _epilog("")
    _attach(app, ())


def _attach(app: typer.Typer, words: tuple[str, ...]) -> None:
    for command in app.registered_commands:
        name = str(command.name or getattr(command.callback, "__name__", ""))
        command.epilog = _epilog(" ".join((*words, name)))
    for group in app.registered_groups:
        name = str(group.name or "")
        group.epilog = _epilog(" ".join((*words, name)))
        if group.typer_instance is not None:
            _attach(group.typer_instance, (*words, name))


def _epilog(command: str) -> str | None:
    examples = EXAMPLES.get(command)
    return None if examples is None else "\n".join(("Examples:", *examples))

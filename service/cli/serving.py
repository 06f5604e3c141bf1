"""The commands about servers: `serve`, and `token create`, `token list`, `token revoke`."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from t6gps.service import config as configuration
from t6gps.service import logs
from t6gps.service.cli import door
from t6gps.service.cli.options import DEFAULT_ROOT, Json, Root, Server
from t6gps.service.logs import Role
from t6gps.service.views import terminal
from t6gps.storage import catalog
from t6gps.storage.errors import ConfigError

token = typer.Typer(no_args_is_help=True, help="Tokens of those who may ask the server of a root.")
TOKEN_COLUMNS = {
    "name": ("token", "{}"),
    "scope": ("scope", "{}"),
    "created": ("created", "{:%Y-%m-%d %H:%M}"),
    "expires": ("expires", "{:%Y-%m-%d %H:%M}"),
    "state": ("state", "{}"),
}
TokenName = Annotated[str, typer.Argument(metavar="NAME", help="Name of a token: who holds it, and what for.")]


def add_to(app: typer.Typer) -> None:
    """Make the commands part of `t6gps`."""
    app.command()(serve)
    app.add_typer(token, name="token")


def serve(
    root: Root = DEFAULT_ROOT,
    host: Annotated[str, typer.Option(help="Address to listen at; any but the loopback address needs TLS.")] = (
        "127.0.0.1"
    ),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port to listen at; 0 takes a free one.")] = 8686,
    names: Annotated[
        list[str] | None, typer.Option("--name", help="Name by which clients ask for this server, beside --host.")
    ] = None,
    cert: Annotated[Path | None, typer.Option("--tls-cert", help="Certificate chain, PEM.")] = None,
    key: Annotated[Path | None, typer.Option("--tls-key", help="Private key, PEM.")] = None,
) -> None:
    """Serve the runs of a root over HTTP, until Ctrl-C; runs at work go on."""
    try:
        from t6gps.service.server import serving
    except ModuleNotFoundError as error:
        raise ConfigError(f"t6gps serve needs {error.name}; install it with: pip install 't6gps[server]'") from None
    logs.become(Role.SERVER)
    address = serving.Address(host=host, port=port, names=names or (), cert=cert, key=key)
    try:
        serving.serve(root, address, terminal.say)
    except KeyboardInterrupt:
        terminal.say("the server has ended; runs at work go on")


def train_there(
    server: str, source: str, run_name: str | None, overrides: list[str], serial: bool, resume: bool
) -> None:
    """Let a server train a run, or go on with one, and say how to follow it. ConfigError for what only works here."""
    if serial:
        raise ConfigError("--serial computes in this process, which a server cannot; leave out --serial or --server")
    with door.connected(server) as client:
        started = client.start(source, run_name, dict(map(configuration.assigned, overrides)), resume)
    for warning in started.warnings:
        terminal.warn(warning)
    typer.echo(f"run {started.name} is at work on the server")
    terminal.say(f"follow it with: t6gps logs -f {started.name} --server {server}")


@token.command()
def create(
    name: TokenName,
    scope: Annotated[str, typer.Option(help="read, operate (runs as well), or admin (tokens as well).")] = "read",
    days: Annotated[float, typer.Option(help="It expires after so many days, at most 366.")] = 30.0,
    root: Root = DEFAULT_ROOT,
    server: Server = None,
) -> None:
    """Create a token and print it; it is shown once and kept nowhere."""
    from pydantic import ValidationError

    from t6gps.service.remote.messages import TokenRequest
    from t6gps.service.server import tokens

    try:
        request = TokenRequest.model_validate({"name": name, "scope": scope, "days": days})
    except ValidationError as error:
        faults = "; ".join(f"{fault['loc'][0]}: {fault['msg']}, found {fault['input']!r}" for fault in error.errors())
        raise ConfigError(f"no such token can be: {faults}; correct it") from None
    if server is None:
        issued = tokens.issue(catalog.whole(root), request, datetime.now(UTC))
    else:
        with door.connected(server) as client:
            issued = client.admin.create_token(request.name, request.scope, request.days)
    typer.echo(issued.token)


@token.command(name="list")
def list_(root: Root = DEFAULT_ROOT, server: Server = None, as_json: Json = False) -> None:
    """List the tokens, without what is secret of them."""
    from t6gps.service.server import tokens

    if server is None:
        lines = tokens.listed(catalog.whole(root))
    else:
        with door.connected(server) as client:
            lines = client.admin.tokens()
    if as_json:
        typer.echo(json.dumps({"tokens": [line.model_dump(mode="json") for line in lines]}))
        return
    now = datetime.now(UTC)
    rows = [line.model_dump() | {"state": "expired" if line.expires <= now else "valid"} for line in lines]
    terminal.print_rows(f"Tokens of {root if server is None else server}", rows, TOKEN_COLUMNS)


@token.command()
def revoke(name: TokenName, root: Root = DEFAULT_ROOT, server: Server = None) -> None:
    """Refuse a token from now on."""
    from t6gps.service.server import tokens

    if server is None:
        tokens.revoke(catalog.whole(root), name)
    else:
        with door.connected(server) as client:
            client.admin.revoke_token(name)
    typer.echo(f"token {name} is revoked")

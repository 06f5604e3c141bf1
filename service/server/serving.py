"""A server on an address: the loopback address by default, TLS on any other."""

from __future__ import annotations

import errno
import ipaddress
import socket
import ssl
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import uvicorn

from t6gps.service.server import app, tokens
from t6gps.service.server.patience import Patient
from t6gps.storage import catalog
from t6gps.storage.errors import ServerError

CONNECTIONS_N = 512
IDLE_S, GRACE_S = 15, 3
BACKLOG_N, STALLED_S = 128, 30.0


@dataclass(frozen=True, kw_only=True)
class Address:
    """Where a server listens.

    names       by which clients may ask for it, beside `host`; a browser led here by another name is refused
    cert, key   files in PEM of the certificate chain and its private key; both or neither
    """

    host: str = "127.0.0.1"
    port: int = 8686
    names: Sequence[str] = ()
    cert: Path | None = None
    key: Path | None = None


def serve(root: Path, address: Address, say: Callable[[str], object]) -> None:
    """Serve the runs of a root until SIGINT or SIGTERM; runs at work go on. `say` is told where it listens.

    ServerError for an address that cannot be used, or one that others reach without TLS.
    """
    root, secured = catalog.whole(root), _secured(address)
    tokens.folder(root)
    known = tokens.listed(root)
    with listening(address) as listener:
        scheme = "https" if secured else "http"
        allowed = _names(address)
        config = uvicorn.Config(
            app.create(root, allowed, scheme),
            ssl_certfile=str(address.cert) if secured else None,
            ssl_keyfile=str(address.key) if secured else None,
            loop="asyncio",
            http=Patient,
            ws="none",
            lifespan="off",
            log_level="warning",
            log_config=None,
            access_log=False,
            server_header=False,
            proxy_headers=False,
            limit_concurrency=CONNECTIONS_N,
            timeout_keep_alive=IDLE_S,
            timeout_graceful_shutdown=GRACE_S,
        )
        say(f"serving {root} at {scheme}://{_bracketed(address.host)}:{listener.getsockname()[1]}")
        if not known:
            say("nobody may ask yet: create a token with t6gps token create")
        uvicorn.Server(config).run(sockets=[listener])


def _secured(address: Address) -> bool:
    """True where it speaks TLS. ServerError where it should and cannot."""
    if address.cert is None and address.key is None:
        if not _is_loopback(address.host):
            raise ServerError(
                f"others reach {address.host}, so that it needs TLS; give --tls-cert and --tls-key, or --host 127.0.0.1"
            )
        return False
    if address.cert is None or address.key is None:
        raise ServerError("TLS needs a certificate and its key; give both --tls-cert and --tls-key")
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(address.cert, address.key, password=_no_password)
    except (OSError, ssl.SSLError) as error:
        raise ServerError(
            f"cannot use certificate {address.cert} with key {address.key}: {error}; give files in PEM that belong "
            "together, the key without a password"
        ) from None
    return True


def _no_password() -> str:
    return ""


def listening(address: Address, stalled_s: float = STALLED_S) -> socket.socket:
    """A socket that listens there; a client that takes nothing for `stalled_s` is dropped by the kernel.

    ServerError with the remedy for its cause where it cannot.
    """
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(
            address.host, address.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listener = socket.socket(family, kind, protocol)
    except (OSError, UnicodeError) as error:
        raise ServerError(f"there is no address {address.host!r}: {error}; give one of this machine's") from None
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(stalled_s * 1000))  # of its clients, too
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        listener.bind(place)
        listener.listen(BACKLOG_N)
    except OSError as error:
        listener.close()
        remedies = {
            errno.EADDRINUSE: "another process listens there; choose another --port, or end that process",
            errno.EACCES: "ports below 1024 need a right of their own; choose a --port from 1024 on",
            errno.EADDRNOTAVAIL: "this machine has no such address; give one that it has with --host",
        }
        remedy = remedies.get(error.errno or 0, "choose another --host or --port")
        raise ServerError(f"cannot listen at {address.host} port {address.port}: {error.strerror}: {remedy}") from None
    return listener


def _names(address: Address) -> frozenset[str]:
    """Names that a Host header may have."""
    here = app.LOOPBACK if _is_loopback(address.host) else frozenset[str]()
    return here | {_bracketed(address.host).lower()} | {name.lower() for name in address.names}


def _is_loopback(host: str) -> bool:
    """True for an address or a name that leads to this machine alone."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return False
    return all(ipaddress.ip_address(place[0]).is_loopback for *_, place in found)


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host

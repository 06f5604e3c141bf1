"""Measures the answer of a server to a query beside Arrow Flight: the same rows, over TLS, on the loopback address.

    .venv/bin/python tests/libraries/flight.py [--megabytes 79] [--rounds 9]

    server         `POST /v1/query` of `t6gps serve`, through `open_store("https://...")`
    flight         a server of Arrow Flight that holds the table, and so does nothing but send it
    flight_asked   the same, which puts the question to the run as `t6gps serve` does, and then sends the result

The rows are all columns of simulated frames. Each server has a process. They take turns, and each answer is held
against the run's rows outside the clock. Prints one JSON object: where the figures come from, seconds of an answer, and
how many times as long the server takes; medians over rounds. Run it on a machine with nothing else to do.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pyarrow as pa
from pyarrow import flight

import t6gps
from t6gps.service.bench.registry import Measurement
from t6gps.service.bench.rounds import Say
from t6gps.service.bench.stores import material
from t6gps.service.bench.stores.contestants import T6Gps
from t6gps.service.provenance import provenance
from t6gps.storage.catalog import Run
from t6gps.storage.sql.query import Question, query

SQL = "SELECT * FROM frames"
SIMULATED_N = 20
"""Episodes of an iteration; each has them again, under other numbers."""


def certificate(folder: Path) -> tuple[Path, Path]:
    """A certificate for localhost that is its own authority, and its key."""
    cert, key = folder / "cert.pem", folder / "key.pem"
    made = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    made += [
        "-subj",
        "/CN=localhost",
        "-addext",
        "subjectAltName=DNS:localhost",
        "-keyout",
        str(key),
        "-out",
        str(cert),
    ]
    subprocess.run(made, check=True, capture_output=True)
    return cert, key


class Flight(flight.FlightServerBase):
    """Sends the table that it holds, or what a run answers, by the name of a contender."""

    def __init__(self, run: Run, certificate: tuple[bytes, bytes]) -> None:
        super().__init__("grpc+tls://localhost:0", tls_certificates=[certificate])
        held = query(Question([run], SQL))
        self._tables = {b"flight": lambda: held, b"flight_asked": lambda: query(Question([run], SQL))}

    def do_get(self, context: object, ticket: flight.Ticket) -> flight.RecordBatchStream:
        return flight.RecordBatchStream(self._tables[ticket.ticket]())


def serve(say: Connection, run: Run, certificate: tuple[bytes, bytes]) -> None:
    """Serve by Flight until killed; say the port."""
    with Flight(run, certificate) as server:
        say.send(server.port)
        server.serve()


@contextmanager
def flying(run: Run, cert: Path, key: Path) -> Iterator[flight.FlightClient]:
    """A client of a process that serves by Flight."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=serve, args=(theirs, run, (cert.read_bytes(), key.read_bytes())), daemon=True)
    process.start()
    theirs.close()
    try:
        yield flight.FlightClient(f"grpc+tls://localhost:{ours.recv()}", tls_root_certs=cert.read_bytes())
    finally:
        process.kill()
        process.join()


@contextmanager
def serving(root: Path, cert: Path, key: Path) -> Iterator[t6gps.Store]:
    """The store of a process of `t6gps serve`."""
    command = [sys.executable, "-m", "t6gps"]
    create = [*command, "token", "create", "bench", "--root", str(root)]
    token = subprocess.run(create, check=True, capture_output=True, text=True).stdout.strip()
    os.environ.update({"T6GPS_TOKEN": token, "SSL_CERT_FILE": str(cert)})
    options = ["--root", str(root), "--port", "0", "--tls-cert", str(cert), "--tls-key", str(key)]
    with subprocess.Popen([*command, "serve", *options], stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stderr is not None, "it is a pipe"
            port = re.search(r"at https://\S+:(\d+)$", process.stderr.readline().strip())
            assert port is not None, process.stderr.read()
            yield t6gps.open_store(f"https://localhost:{port[1]}")
        finally:
            process.kill()


def take_turns(
    ways: Mapping[str, Callable[[], pa.Table]], expected: pa.Table, rounds: int, say: Say
) -> dict[str, float]:
    """The figures by name; the first round warms up. RuntimeError for an answer with other rows."""
    rows = list[list[float]]()
    for number in range(rounds + 1):
        seconds = dict[str, float]()
        for name in list(ways) if number % 2 else reversed(list(ways)):
            start = time.perf_counter()
            answer = ways[name]()
            seconds[name] = time.perf_counter() - start
            if not answer.equals(expected):
                raise RuntimeError(f"{name} gives other rows than the run has")
        rows.append([seconds[name] for name in ways])
        say(f"round {number} of {rounds}: " + ", ".join(f"{name} {rows[-1][i]:.2f} s" for i, name in enumerate(ways)))
    taken = np.array(rows[1:])
    figures = {f"{name}_s": float(median) for name, median in zip(ways, np.median(taken, axis=0), strict=True)}
    ratios = np.median(taken[:, :1] / taken, axis=0)
    return figures | {f"server_over_{name}": float(ratio) for name, ratio in list(zip(ways, ratios, strict=True))[1:]}


def measure(megabytes: float, rounds: int, say: Say) -> dict[str, float]:
    """The figures of so many rounds with a table of so many MB, or a little more."""
    with tempfile.TemporaryDirectory() as folder:
        root, episodes = Path(folder) / "runs", material.simulated(SIMULATED_N, say)
        kept, (cert, key) = T6Gps(root), certificate(Path(folder))
        for iteration in range(int(np.ceil(1e6 * megabytes / material.raw_bytes(episodes)))):
            kept.append(iteration, material.of_iteration(episodes, iteration))
        expected = query(Question([kept.run], SQL))
        with serving(root, cert, key) as store, flying(kept.run, cert, key) as client:
            ways = {"server": lambda: store.sql(SQL).arrow()} | {
                name: lambda name=name: client.do_get(flight.Ticket(name.encode())).read_all()
                for name in ("flight", "flight_asked")
            }
            return {"megabytes": expected.nbytes / 1e6, **take_turns(ways, expected, rounds, say)}


def main() -> None:
    parser = argparse.ArgumentParser(description="The answer of a server to a query beside Arrow Flight, over TLS.")
    parser.add_argument("--megabytes", type=float, default=79.0, help="of the table")
    parser.add_argument("--rounds", type=int, default=9, help="turns of each contender")
    chosen = parser.parse_args()
    figures = measure(chosen.megabytes, chosen.rounds, lambda line: print(line, file=sys.stderr))
    print(Measurement("flight", provenance(), 1, (), dict(figures)).to_json())


if __name__ == "__main__":
    main()

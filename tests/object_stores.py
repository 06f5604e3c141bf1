"""Real object stores on the loopback interface: SeaweedFS, which tests publish to, and rclone, which is refused."""

from __future__ import annotations

import json
import random
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

import failing_object
from obstore.store import S3Store

KEY, SECRET, BUCKET = "tests", "secret-of-tests", "bucket"
MAKER = "maker"
"""May make buckets, which a store must not do by itself."""
READY, READY_S = b"ready", 180.0
"""What is written first, and read: a store keeps what is empty beside its volumes, which begin to serve later."""
PORTS = range(20_000, 32_000)
"""Linux takes the ports of connections from 32,768 on, and would give away that of a server that starts again."""


@dataclass
class Store:
    """A server that can be killed and started again, with what it keeps."""

    command: Sequence[str]
    folder: Path
    port: int
    process: subprocess.Popen[bytes] | None = field(default=None)

    @property
    def environment(self) -> dict[str, str]:
        """The variables that lead to it."""
        return {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{self.port}",
            "AWS_ACCESS_KEY_ID": KEY,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "AWS_REGION": "us-east-1",
        }

    def start(self) -> None:
        """Start it, and wait until it answers."""
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(self.command, cwd=self.folder, stdout=log, stderr=log)
        deadline = time.monotonic() + READY_S
        while not self._answers():
            assert self.process.poll() is None, (self.folder / "log").read_text()[-2000:]
            assert time.monotonic() < deadline, f"the store does not answer after {READY_S} s"
            time.sleep(0.05)  # its process brings it about: there is nothing to wait on but the clock

    def kill(self) -> None:
        """Kill it, as a power failure would."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def _answers(self) -> bool:
        """True when the bucket can be made, or is there, and keeps what it is given."""
        keys = {"aws_access_key_id": MAKER, "aws_secret_access_key": SECRET, "aws_region": "us-east-1"}
        maker = S3Store(
            BUCKET,
            config={**keys, "aws_endpoint": f"http://127.0.0.1:{self.port}"},
            client_options={"allow_http": True, "timeout": "2s"},
            retry_config={"max_retries": 0},
        )
        try:
            maker.put(".ready", READY)
            return bytes(maker.get(".ready").bytes()) == READY
        except Exception:  # obstore's own have no narrower parent
            return False


def _ports(count: int) -> list[int]:
    """Ports that are free, and that no connection takes by chance."""
    found: list[int] = []
    with ExitStack() as stack:
        for port in random.sample(PORTS, len(PORTS)):
            with suppress(OSError):  # it is taken
                stack.enter_context(socket.create_server(("127.0.0.1", port)))
                found.append(port)
            if len(found) == count:
                break
    return found


def _program(name: str) -> str:
    return str(Path(sys.executable).with_name(name))


@contextmanager
def seaweed(folder: Path) -> Iterator[Store]:
    """SeaweedFS: a store that creates an object only where there is none, when it is asked so."""
    actions = {KEY: ["Read", "Write", "List"], MAKER: ["Admin"]}
    identities = [
        {"name": key, "credentials": [{"accessKey": key, "secretKey": SECRET}], "actions": allowed}
        for key, allowed in actions.items()
    ]
    (folder / "s3.json").write_text(json.dumps({"identities": identities}))
    names = ("master.port", "volume.port", "filer.port", "s3.port")
    names += tuple(f"{name}.grpc" for name in names)
    ports = dict(zip(names, _ports(len(names)), strict=True))
    command = [
        *(_program("weed"), "server", "-s3", "-ip=127.0.0.1", "-ip.bind=127.0.0.1", "-s3.config=s3.json", "-dir=."),
        *("-master.telemetry=false", "-s3.port.iceberg=0", "-s3.port.lance=0", "-master.volumeSizeLimitMB=64"),
        *(f"-{name}={port}" for name, port in ports.items()),
    ]
    yield from _running(Store(command, folder, ports["s3.port"]))


@contextmanager
def rclone(folder: Path) -> Iterator[Store]:
    """Rclone's server: a store that ignores If-None-Match."""
    (folder / "data" / BUCKET).mkdir(parents=True)
    (port,) = _ports(1)
    keys = [f"--auth-key={key},{SECRET}" for key in (KEY, MAKER)]
    command = [_program("rclone"), "serve", "s3", *keys, f"--addr=127.0.0.1:{port}", "data"]
    yield from _running(Store(command, folder, port))


@contextmanager
def failing(store: Store, path: str) -> Iterator[str]:
    """The address of a store that is well, but for one object: whoever reads that is told of an internal error."""
    command = [sys.executable, failing_object.__file__, str(store.port), path]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as between:
        try:
            assert between.stdout is not None, "it is a pipe"
            yield f"http://127.0.0.1:{int(between.stdout.readline())}"
        finally:
            between.kill()


def _running(store: Store) -> Iterator[Store]:
    try:
        store.start()
        yield store
    finally:
        store.kill()

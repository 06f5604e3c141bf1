"""Clients of a server, in a process of their own: some ask for a run's status, others take answers slowly or never.

They speak HTTP themselves, so that they cost the machine little.
"""

from __future__ import annotations

import asyncio
import socket
import time
from collections.abc import Coroutine
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from urllib.parse import urlsplit

ASKING_N, SLOW_N, DEAD_N = 30, 10, 10
EVERY_S = 1.0
"""Whoever asks does so once in that time, and who is slow takes SIP_BYTES in it."""
SIP_BYTES, RECEIVE_BYTES = 1024, 4096
RENEWED_S = 10.0
"""Whoever takes nothing asks anew after that time, as if it were another."""
LARGE = "large.png"
"""A figure of the run that is larger than what sockets hold."""


@dataclass
class Load:
    """Clients of a run of a server; `latencies_s` of those that ask for the status, `wrong` answers that they got."""

    url: str
    token: str
    run: str
    latencies_s: list[float] = field(default_factory=list)
    wrong: list[str] = field(default_factory=list)

    async def ask(self, number: int) -> None:
        """Ask for the status again and again, on one connection; not all at the same time."""
        await asyncio.sleep(EVERY_S * number / ASKING_N)
        reader, writer = await self._connected()
        due_s = time.monotonic()
        while True:
            begin_s = time.monotonic()
            writer.write(self._request(f"/v1/runs/{self.run}/status"))
            head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
            length = next(line for line in head.lower().split("\r\n") if line.startswith("content-length:"))
            body = await reader.readexactly(int(length.partition(":")[2]))
            self.latencies_s.append(time.monotonic() - begin_s)
            if " 200 " not in head.partition("\r\n")[0] or not body.startswith(b"{"):
                self.wrong.append(f"{head.partition(chr(13))[0]}: {body[:200].decode(errors='replace')}")
            due_s += EVERY_S
            await asyncio.sleep(max(0.0, due_s - time.monotonic()))

    async def sip(self) -> None:
        """Take an answer slowly."""
        reader, writer = await self._connected()
        writer.write(self._request(f"/v1/runs/{self.run}/figures/{LARGE}"))
        while await reader.read(SIP_BYTES):
            await asyncio.sleep(EVERY_S)

    async def hang(self, number: int) -> None:
        """Ask for what is large, or for what has no end, and take nothing."""
        paths = (f"/v1/runs/{self.run}/figures/{LARGE}", f"/v1/runs/{self.run}/events")
        while True:
            _, writer = await self._connected()
            writer.write(self._request(paths[number % len(paths)]))
            await asyncio.sleep(RENEWED_S)
            writer.close()

    async def _connected(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        place, connection = urlsplit(self.url), socket.socket()
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BYTES)
        connection.setblocking(False)
        await asyncio.get_running_loop().sock_connect(connection, (place.hostname, place.port))
        return await asyncio.open_connection(sock=connection, limit=RECEIVE_BYTES)

    def _request(self, path: str) -> bytes:
        lines = (f"GET {path} HTTP/1.1", f"Host: {urlsplit(self.url).netloc}", f"Authorization: Bearer {self.token}")
        return "\r\n".join((*lines, "", "")).encode()

    async def bear(self, connection: Connection) -> None:
        """Be all the clients until somebody says that it is enough."""
        clients: list[Coroutine[None, None, None]] = [
            *(self.ask(number) for number in range(ASKING_N)),
            *(self.sip() for _ in range(SLOW_N)),
            *(self.hang(number) for number in range(DEAD_N)),
        ]
        tasks = [asyncio.create_task(client) for client in clients]
        await asyncio.to_thread(connection.recv)
        self.wrong += [repr(task.exception()) for task in tasks if task.done()]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def clients(connection: Connection, url: str, token: str, run: str) -> None:
    """The process: True begins a turn of the clients, anything ends it; latencies and wrong answers are sent back."""
    while connection.recv():
        load = Load(url, token, run)
        asyncio.run(load.bear(connection))
        connection.send((load.latencies_s, load.wrong))

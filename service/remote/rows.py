"""The rows that a server answers with, read while they come."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import final

import pyarrow as pa

from t6gps.service.api.asking import Parameters, Warn
from t6gps.service.remote.client import Client, question
from t6gps.service.remote.messages import QueryForm


@final
class _Body(io.RawIOBase):
    """A body as a file that is read once."""

    def __init__(self, chunks: Iterator[bytes]) -> None:
        self._chunks, self._rest = chunks, memoryview(b"")

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override] # what BufferedReader gives
        while not self._rest:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._rest = memoryview(chunk)
        taken_n = min(len(buffer), len(self._rest))
        buffer[:taken_n] = self._rest[:taken_n]
        self._rest = self._rest[taken_n:]
        return taken_n


@contextmanager
def opened(client: Client, runs: str, sql: str, parameters: Parameters, warn: Warn) -> Iterator[pa.RecordBatchReader]:
    """The result of one SELECT over a run, or over those that match a pattern. `warn` is told of runs left out.

    ServerError for an answer that ends before its last batch, or is none.
    """
    asked = question(runs, sql, QueryForm.ARROW, parameters)
    with closing(client.server.chunks("/query", asked, warn)) as chunks:
        try:
            yield pa.ipc.open_stream(pa.PythonFile(io.BufferedReader(_Body(chunks), 2**20), "r"))
        except pa.ArrowException as error:
            raise client.server.nonsense(error) from None

"""SQL in this process, for what the program's own user asks: the same one SELECT over the same tables, without bounds
on time, memory and result, and without a process to start.

DuckDB computes with one thread, so that a question has the same answer to the last bit each time; reading the files
takes all cores. What an error says is what a sandbox would say.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import final

import pyarrow as pa

from t6gps.storage.errors import DataError, QueryError, StoreError
from t6gps.storage.sql import advice, cache, engine, formats, query, sandbox, views
from t6gps.storage.sql.engine import Engine, RunFiles
from t6gps.storage.sql.query import Question

IDLE_N = 2
"""Engines that are kept for the next question."""
_SETTINGS = {"threads": 1}


@final
class InProcess:
    """Answers questions, any number of them at once. Engines that have answered one are kept, with the tables shown."""

    def __init__(self) -> None:
        self._idle: dict[int, list[Engine]] = {}  # by process: a fork has none of the threads of its parent's

    def __reduce__(self) -> tuple[type[InProcess], tuple[()]]:
        return InProcess, ()

    @contextmanager
    def answered(self, question: Question) -> Iterator[pa.RecordBatchReader]:
        """The rows of a question's result, as they come. Raises errors as `query.query` does."""
        query.check_size(question.sql)
        files, about = query.read(question)
        idle = self._idle.setdefault(os.getpid(), [])
        asked = idle.pop() if idle else Engine(_SETTINGS)
        try:
            asked.show(files, about)
            yield formats.rows(asked.ask(question.sql, question.parameters))
        except engine.ERRORS as error:
            raise _explained(error, question, files, about) from error
        if len(idle) < IDLE_N:
            idle.append(asked)


def _explained(
    error: Exception, question: Question, files: Mapping[str, RunFiles], about: pa.Table
) -> QueryError | DataError | StoreError:
    if damage := sandbox.fault(error, files):
        if cache.forget_torn(question.runs):
            return QueryError("what was kept for queries below the root was damaged and is removed; ask again")
        return query.damaged(question.runs, *damage)
    return QueryError(advice.explained(error, question.sql, views.asked(about.schema)))


def ask(question: Question) -> pa.Table:
    """The result of a question, as `query.query` returns it."""
    with _OWN.answered(question) as rows:
        return rows.read_all()


_OWN = InProcess()
"""Of whoever asks a single run."""

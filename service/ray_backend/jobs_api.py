"""A cluster of Ray by its Jobs API, over HTTP: jobs are submitted, looked at and stopped, and errands are run."""

from __future__ import annotations

import asyncio
import json
import logging
import shlex
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from concurrent.futures import Future
from importlib import import_module
from pathlib import Path
from typing import TypeVar
from urllib import request
from urllib.error import HTTPError

import ray
from ray.exceptions import AuthenticationError
from ray.job_submission import JobDetails, JobSubmissionClient

from t6gps.service.ray_backend import private
from t6gps.storage.errors import ConfigError, RunError

Answer = TypeVar("Answer")
CONNECT_S, ANSWER_S = 10.0, 60.0
"""How long the head has to accept a connection, and to answer."""
ERRAND_S, TICK_S = 150.0, 0.1
"""How long an errand may take: it starts a process on each node. And how often it is looked at."""
STOP_S = 45
"""How long a job that is asked to stop has before Ray kills it; Ray's own 3 s are short for a phase that ends."""
UNKNOWN = "status code 404"
"""What Ray's client says of a job that the cluster does not know."""
CHATTY = ("ray.dashboard.modules.dashboard_sdk", "ray._private.runtime_env.packaging")
"""Loggers of Ray that tell of each upload."""
OF_RAY = ("Running entrypoint for job", "Runtime env is setting up")
"""Lines that Ray writes into the log of a job, perhaps after those of the job itself."""
REFUSED = (401, 403)
TOKEN = "give its token (RAY_AUTH_MODE=token and RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH)"
REACH = "see that the cluster's head runs with its dashboard (ray[default]), and correct ray.address"
INSTALL = "install this version of t6gps on the cluster's nodes, and set ray.bin to the folder of its programs"
ENVIRONMENT: dict[str, object] = {"env_vars": {"RAY_JOB_STOP_WAIT_TIME_S": str(STOP_S)}}
"""Of every job, in Ray's words."""
ERRANDS, RESULT = "t6gps.service.ray_backend.errands", "result: "
"""The module of errands, and how the line begins that holds what one brings."""


class JobsApi:
    """The Jobs API at an address, http://HEAD:8265. Its methods raise RunError where the cluster does not answer.

    It authenticates as Ray does: RAY_AUTH_MODE=token, with RAY_AUTH_TOKEN or RAY_AUTH_TOKEN_PATH.
    """

    def __init__(self, address: str) -> None:
        """Connect. ConfigError without Ray's client; RunError for a cluster with another version of Ray."""
        try:
            import_module("aiohttp")  # without it Ray has no such client
        except ModuleNotFoundError as error:
            raise ConfigError(f"--to ray needs {error.name}; install it with: pip install 't6gps[cluster]'") from None
        for name in CHATTY:
            logging.getLogger(name).setLevel(logging.WARNING)
        self.address = address
        private.read_authentication()
        found = _version(address)
        if found != ray.__version__:
            raise RunError(f"{address} has Ray {found}, and this machine {ray.__version__}; install the same on both")
        self._client = self._answer(lambda: JobSubmissionClient(address))

    def submit(self, command: Sequence[str], programs: str | None, folder: Path | None = None) -> str:
        """Submit a job; its number. `programs` comes first in its PATH; it starts in a copy of `folder`."""
        environment = ENVIRONMENT | ({} if folder is None else {"working_dir": str(folder)})
        call = entrypoint(command, programs)
        return self._answer(lambda: self._client.submit_job(entrypoint=call, runtime_env=environment))

    def details(self, job: str) -> JobDetails | None:
        """What the cluster knows of a job, None when it knows none of that number."""
        try:
            return self._answer(lambda: self._client.get_job_info(job))
        except RunError as error:
            if UNKNOWN in str(error):
                return None
            raise

    def stop(self, job: str) -> None:
        """Ask a job to stop; Ray kills it after STOP_S."""
        self._answer(lambda: self._client.stop_job(job))

    def log(self, job: str) -> str:
        """What a job has written."""
        return self._answer(lambda: self._client.get_job_logs(job))

    def follow(self, job: str) -> Iterator[str]:
        """What a job has written, and goes on to write, until it ends."""
        lines = self._client.tail_job_logs(job)
        with asyncio.Runner() as runner:
            while (text := self._said(lambda: runner.run(_next(lines)))) is not None:
                yield text

    def errand(self, programs: str | None, name: str, *arguments: str, folder: Path | None = None) -> str:
        """Run an errand on the cluster's head; the JSON that it brings. RunError where it fails, with its error.

        Its record stays: Ray takes the end of a job that is deleted for a fault of its own.
        """
        job = self.submit(["python", "-P", "-m", ERRANDS, name, *arguments], programs, folder)
        deadline = time.monotonic() + ERRAND_S
        while (details := self.details(job)) is not None and not details.status.is_terminal():
            if time.monotonic() > deadline:
                self.stop(job)
                raise RunError(f"{self.address}: no job ends within {ERRAND_S:.0f} s; see the cluster's load")
            time.sleep(TICK_S)
        if details is None:
            raise RunError(f"{self.address}: the cluster has restarted just now; try again")
        lines = self.log(job).splitlines()
        results = [line.removeprefix(RESULT) for line in lines if line.startswith(RESULT)]
        if results:
            return results[-1]
        raise RunError(f"on the cluster {self.address}: {_why(last_words(lines) or details.message or 'no word')}")

    def _answer(self, ask: Callable[[], Answer]) -> Answer:
        """What the cluster answers, in a thread: Ray's client would wait for ever."""
        answer: Future[Answer] = Future()

        def wait() -> None:
            try:
                answer.set_result(ask())
            except Exception as error:  # it is raised where somebody waits
                answer.set_exception(error)

        threading.Thread(target=wait, daemon=True).start()
        return self._said(lambda: answer.result(ANSWER_S))

    def _said(self, ask: Callable[[], Answer]) -> Answer:
        """An answer. RunError with a remedy for whatever Ray's client raises."""
        try:
            return ask()
        except AuthenticationError:
            raise RunError(f"{self.address} does not accept the token; {TOKEN}") from None
        except TimeoutError:
            raise RunError(f"{self.address} has not answered within {ANSWER_S:.0f} s; {REACH}") from None
        except Exception as error:  # Ray has no narrower one
            remedy = REACH if isinstance(error, OSError) else "see the log of the cluster's dashboard"
            raise RunError(f"{self.address}: {' '.join(str(error).split())}; {remedy}") from None


def entrypoint(command: Sequence[str], programs: str | None) -> str:
    """A command as the shell of a job takes it."""
    return ("" if programs is None else f"PATH={shlex.quote(programs)}:$PATH ") + shlex.join(command)


async def _next(lines: AsyncIterator[str]) -> str | None:
    return await anext(lines, None)


def _version(address: str) -> str:
    """The version of Ray at an address. RunError where none answers, or not to this token."""
    asked = request.Request(f"{address}/api/version", headers=private.authentication_headers())
    try:
        with request.urlopen(asked, timeout=CONNECT_S) as answer:
            version: str = json.load(answer)["ray_version"]
            return version
    except HTTPError as error:
        if error.code in REFUSED:
            raise RunError(f"{address} does not accept the token ({error}); {TOKEN}") from None
        raise RunError(f"no Jobs API of Ray answers at {address} ({error}); {REACH}") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = getattr(error, "reason", error)
        raise RunError(f"no Jobs API of Ray answers at {address} ({reason}); {REACH}") from None


def last_words(lines: Sequence[str]) -> str:
    """What a job said last: its error, else the last line that says something; empty where none does."""
    said = [line.strip() for line in lines if line.strip() and not any(words in line for words in OF_RAY)]
    return next((line for line in reversed(said) if line.startswith("error: ")), said[-1] if said else "")


def _why(words: str) -> str:
    """What went wrong with an errand, by its last words."""
    if "No module named" in words or "not found" in words:
        return f"{words}; {INSTALL}"
    return words.removeprefix("error: ")

"""An S3 object store as the usual environment variables name it, for the three libraries that speak to it.

AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY   the keys, always; AWS_SESSION_TOKEN with temporary ones
AWS_REGION                                 or AWS_DEFAULT_REGION; us-east-1 by default
AWS_ENDPOINT_URL                           of a store that is not Amazon's; https, or http on this machine
AWS_ALLOW_HTTP                             true lets keys and data pass other machines as plain text

obstore lists, reads and creates objects, deltalake reads logs, pyarrow reads Parquet files. They reach the same store.
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from pyarrow import fs

from t6gps.storage.errors import ConfigError, StoreError, StoreUnreachableError

if TYPE_CHECKING:
    from obstore.store import S3Store

CONNECT_S, READ_S, WRITE_S = 5, 30, 600
"""To reach the store, for an answer, and for an object that is sent or fetched whole: 80 MB at 1 Mbit/s."""
RETRIES_N, RETRY_S = 2, 10
LOOPBACK = ("127.0.0.1", "localhost", "::1")
_CODE = re.compile(r"<Code>(\w+)</Code>|AWS Error ((?!UNKNOWN)[A-Z_]+)")
_STATUS = re.compile(r"status(?: code)?[\s:↳]+(\d{3})")
_AWAY = re.compile(r"HTTP error|AWS Error (NETWORK_|REQUEST_TIMEOUT|SERVICE_UNAVAILABLE|SLOW_DOWN|INTERNAL_FAILURE)")
_COLOUR = re.compile("\x1b\\[[0-9;]*m")
_PREFIX = "AWS_"
_KEYS = ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY")


@dataclass(frozen=True)
class Access:
    """How the store is reached."""

    key: str
    secret: str
    token: str | None
    region: str
    endpoint: str | None

    @property
    def name(self) -> str:
        """The store, for people."""
        return self.endpoint or f"Amazon S3 in {self.region}"

    @property
    def plain(self) -> bool:
        """Whether http is spoken."""
        return self.endpoint is not None and self.endpoint.startswith("http:")


def variables() -> dict[str, str]:
    """The variables that say how the store is reached, for another process."""
    return {name: value for name, value in os.environ.items() if name.startswith(_PREFIX)}


def access() -> Access:
    """What the environment says. ConfigError naming the variable that is missing or not allowed."""
    missing = [name for name in _KEYS if not os.environ.get(name)]
    if missing:
        raise ConfigError(f"s3:// needs the keys of the object store; set {' and '.join(missing)}")
    region = os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION") or "us-east-1"
    endpoint = os.environ.get("AWS_ENDPOINT_URL") or None
    if endpoint is not None:
        found = urlsplit(endpoint)
        if found.scheme not in ("http", "https") or not found.hostname or found.path.strip("/"):
            raise ConfigError(f"AWS_ENDPOINT_URL must be https://HOST or https://HOST:PORT, found {endpoint!r}")
        allowed = os.environ.get("AWS_ALLOW_HTTP", "").lower() == "true"
        if found.scheme == "http" and found.hostname not in LOOPBACK and not allowed:
            raise ConfigError(
                f"AWS_ENDPOINT_URL={endpoint} would send data as plain text over the network; use https, or set "
                "AWS_ALLOW_HTTP=true"
            )
        endpoint = endpoint.rstrip("/")
    key, secret = (os.environ[name] for name in _KEYS)
    return Access(key, secret, os.environ.get("AWS_SESSION_TOKEN") or None, region, endpoint)


def options(reached: Access) -> dict[str, str]:
    """The store's place and keys, as obstore and deltalake name them."""
    named = {
        "aws_access_key_id": reached.key,
        "aws_secret_access_key": reached.secret,
        "aws_session_token": reached.token,
        "aws_region": reached.region,
        "aws_endpoint": reached.endpoint,
    }
    return {key: value for key, value in named.items() if value is not None}


def require() -> None:
    """ConfigError where obstore is not installed."""
    try:
        import obstore  # noqa: F401 # it is only looked for
    except ModuleNotFoundError as error:
        raise ConfigError(f"s3:// needs {error.name}; install it with: pip install 't6gps[s3]'") from None


def client(bucket: str, timeout_s: int = READ_S) -> S3Store:
    """Obstore's client of a bucket. ConfigError as `access`."""
    return _client(bucket, timeout_s, access())


@lru_cache
def _client(bucket: str, timeout_s: int, reached: Access) -> S3Store:
    from obstore.store import S3Store

    return S3Store(
        bucket,
        config=options(reached),  # type: ignore[arg-type]  # it takes any of its keys
        client_options={"allow_http": reached.plain, "connect_timeout": f"{CONNECT_S}s", "timeout": f"{timeout_s}s"},
        retry_config={"max_retries": RETRIES_N, "retry_timeout": timedelta(seconds=RETRY_S)},
    )


def file_system() -> fs.S3FileSystem:
    """Pyarrow's file system, in which a path is BUCKET/KEY."""
    return _file_system(access())


@lru_cache
def _file_system(reached: Access) -> fs.S3FileSystem:
    place = urlsplit(reached.endpoint or "https://")
    return fs.S3FileSystem(
        access_key=reached.key,
        secret_key=reached.secret,
        session_token=reached.token,
        region=reached.region,
        scheme=place.scheme,
        endpoint_override=place.netloc or None,
        connect_timeout=CONNECT_S,
        request_timeout=READ_S,
        retry_strategy=fs.AwsStandardS3RetryStrategy(max_attempts=1 + RETRIES_N),
    )


def delta_options() -> dict[str, str]:
    """What deltalake is told of the store."""
    reached = access()
    return {
        **options(reached),
        "allow_http": str(reached.plain).lower(),
        "connect_timeout": f"{CONNECT_S}s",
        "timeout": f"{READ_S}s",
        "max_retries": str(RETRIES_N),
        "retry_timeout": f"{RETRY_S}s",
    }


@contextmanager
def asking(bucket: str, place: str) -> Iterator[None]:
    """What obstore says of a place becomes FileNotFoundError, FileExistsError, or the StoreError of `explained`."""
    from obstore.exceptions import AlreadyExistsError, BaseError

    try:
        yield
    except AlreadyExistsError:
        raise FileExistsError(errno.EEXIST, "there is an object already", place) from None
    except FileNotFoundError as error:
        if "NoSuchBucket" in str(error):
            raise explained(error, bucket) from None
        raise FileNotFoundError(errno.ENOENT, "no such object", place) from None
    except BaseError as error:
        raise explained(error, bucket) from None


def away(error: Exception) -> bool:
    """True where obstore, deltalake or pyarrow says that the store does not answer, or cannot now: 429, 5xx."""
    text = _COLOUR.sub("", str(error))
    status = _STATUS.search(text)
    return bool(_AWAY.search(text)) or (status is not None and (status[1] == "429" or status[1].startswith("5")))


def explained(error: Exception, bucket: str) -> StoreError:
    """What the store has answered, or that it does not, with the remedy."""
    text, name = _COLOUR.sub("", str(error)), access().name
    code, status = _CODE.search(text), _STATUS.search(text)
    said = code[1] or code[2] if code else f"status {status[1]}" if status else None
    if said == "NoSuchBucket":
        return StoreError(f"there is no bucket {bucket!r} at {name}; make it, or correct the s3:// address")
    if said in ("AccessDenied", "InvalidAccessKeyId", "SignatureDoesNotMatch", "status 401", "status 403"):
        return StoreError(
            f"{name} refuses the bucket {bucket!r}: {said}; correct {' and '.join(_KEYS)}, or let them use the bucket"
        )
    if said is not None and not away(error):
        return StoreError(f"{name} has answered {said} for the bucket {bucket!r}; see whether it is an S3 store")
    sentence = " ".join(text.split("\n\nDebug source", maxsplit=1)[0].split())
    reason = (said or sentence.rpartition(" - ")[2])[:300]
    return StoreUnreachableError(
        f"{name} does not answer for the bucket {bucket!r}: {reason}; see AWS_ENDPOINT_URL and the network, then repeat"
    )

"""Places in an object store as paths that are read like folders and files: s3://BUCKET/KEY.

A run below such a root is read by the code that reads a folder. Everything that would write, or that asks the file
system of this machine, ends in one error: `__fspath__` refuses, which every such call needs.
"""

from __future__ import annotations

import errno
import io
import os
import re
import stat
from collections.abc import Generator, Iterable
from contextlib import suppress
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from pathlib import Path, PosixPath
from typing import IO, TYPE_CHECKING, final

import pyarrow as pa
from pyarrow import fs

from t6gps.storage.errors import RunError, StoreError
from t6gps.storage.objects import store

if TYPE_CHECKING:
    from obstore import ObjectMeta
    from obstore.store import S3Store

SCHEME = "s3:"
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_KEY = re.compile(r"[A-Za-z0-9_.-]+")


def is_object(path: Path) -> bool:
    """True for s3://..., also as a Path writes it, with one slash."""
    return path.parts[:1] == (SCHEME,)


def at(path: str | Path) -> Path:
    """A path of this machine as it is, or a place in an object store. Errors as `whole`."""
    return whole(Path(path)) if is_object(Path(path)) else Path(path)


def whole(path: Path) -> ObjectPath:
    """A place in an object store. RunError for an address that none can have, ConfigError without keys or obstore."""
    store.access()
    store.require()
    return addressed(path)


def addressed(path: Path) -> ObjectPath:
    """A place in an object store that others may reach. RunError for an address that none can have."""
    bucket, keys = path.parts[1:2], path.parts[2:]
    if not bucket or not _BUCKET.fullmatch(bucket[0]):
        raise RunError(f"an object store is s3://BUCKET or s3://BUCKET/PREFIX, found {path}; name a bucket")
    wrong = [key for key in keys if not _KEY.fullmatch(key) or key in (".", "..")]
    if wrong:
        raise RunError(
            f"a prefix may have letters, digits, '-', '_' and '.', found {wrong[0]!r}; choose another prefix"
        )
    return ObjectPath(path)


@final
class ObjectPath(PosixPath):
    """A place in a bucket: an object, or the folder of those whose keys begin with it.

    Errors are those of a folder, FileNotFoundError above all, and StoreError where the store refuses or is away.
    """

    def __str__(self) -> str:
        text = super().__str__()
        return f"{SCHEME}//{text.removeprefix(f'{SCHEME}/')}" if is_object(self) else text

    def __fspath__(self) -> str:
        raise only_read(self)

    @property
    def bucket(self) -> str:
        return self.parts[1]

    @property
    def key(self) -> str:
        """Its key in the bucket; "" for the bucket itself."""
        return "/".join(self.parts[2:])

    def client(self, timeout_s: int = store.READ_S) -> S3Store:
        """What asks the store."""
        return store.client(self.bucket, timeout_s)

    def stat(self, *, follow_symlinks: bool = True) -> os.stat_result:
        """Kind and size. FileNotFoundError where there is neither an object nor a folder."""
        import obstore

        try:
            with store.asking(self.bucket, str(self)):
                found = obstore.head(self.client(), self.key) if self.key else None
        except FileNotFoundError:
            found = None
        if found is not None:
            return _stat(stat.S_IFREG, found["size"], found["last_modified"])
        with store.asking(self.bucket, str(self)):
            below = next(iter(obstore.list(self.client(), self._folder, chunk_size=1)), ())
        if not below:
            raise FileNotFoundError(errno.ENOENT, "no such object", str(self))
        return _stat(stat.S_IFDIR, 0, datetime.fromtimestamp(0, UTC))

    def below(self) -> dict[str, int]:
        """Sizes of all objects below it, by their paths from here."""
        import obstore

        with store.asking(self.bucket, str(self)):
            pages: Iterable[Iterable[ObjectMeta]] = obstore.list(self.client(), self._folder)
            found = {each["path"]: each["size"] for page in pages for each in page}
        start = len(self.key) + 1 if self.key else 0
        return {key[start:]: size for key, size in found.items()}

    def iterdir(self) -> Generator[ObjectPath, None, None]:
        folders, files = self._entries()
        yield from (self / name for name in (*folders, *files))

    def sizes(self) -> dict[str, int]:
        """Sizes of the objects directly in it, by name."""
        return self._entries()[1]

    def glob(self, pattern: str) -> Generator[ObjectPath, None, None]:
        """The places that match; a pattern of several parts matches one folder for each."""
        first, _, others = pattern.partition("/")
        try:
            folders, files = self._entries()
        except FileNotFoundError:
            return
        for name in (*folders, *([] if others else files)):
            if fnmatchcase(name, first):
                yield from (self / name).glob(others) if others else iter([self / name])

    def rglob(self, pattern: str) -> Generator[ObjectPath, None, None]:
        """The objects below it, in all folders, whose names match."""
        yield from (self / key for key in self.below() if fnmatchcase(key.rpartition("/")[2], pattern))

    def read_bytes(self) -> bytes:
        import obstore

        with store.asking(self.bucket, str(self)):
            return bytes(obstore.get(self.client(), self.key).bytes())

    def read_text(self, encoding: str | None = None, errors: str | None = None) -> str:
        return self.read_bytes().decode(encoding or "utf-8", errors or "strict")

    def open(  # type: ignore[override]  # it reads, in pieces
        self,
        mode: str = "r",
        buffering: int = -1,
        encoding: str | None = None,
        errors: str | None = None,
        newline: str | None = None,
    ) -> IO[bytes] | IO[str]:
        if mode == "rb":
            return self.source()
        if mode == "r":
            return io.StringIO(self.read_text(encoding, errors))
        return super().open(mode, buffering, encoding, errors, newline)  # which refuses

    def source(self) -> pa.NativeFile:
        """Its content for pyarrow, read where it is asked. OSError where the store does not give it."""
        return store.file_system().open_input_file(f"{self.bucket}/{self.key}")

    @property
    def _folder(self) -> str | None:
        return f"{self.key}/" if self.key else None

    def _entries(self) -> tuple[list[str], dict[str, int]]:
        """Names of the folders in it, and sizes of the objects. FileNotFoundError where there is none."""
        import obstore

        with store.asking(self.bucket, str(self)):
            found = obstore.list_with_delimiter(self.client(), self._folder)
        if self.key and not (found["common_prefixes"] or found["objects"]):
            raise FileNotFoundError(errno.ENOENT, "no such object", str(self))
        names = [prefix.rstrip("/").rpartition("/")[2] for prefix in found["common_prefixes"]]
        return names, {each["path"].rpartition("/")[2]: each["size"] for each in found["objects"]}


def only_read(path: ObjectPath) -> StoreError:
    """The error of what would write there."""
    return StoreError(
        f"{path} is in an object store, which is only read; give a folder as the root, or copy the run to one with "
        "t6gps cp"
    )


def _stat(kind: int, size: int, changed: datetime) -> os.stat_result:
    time_s = int(changed.timestamp())
    exact = {"st_mtime_ns": int(changed.timestamp() * 1e6) * 1000}
    return os.stat_result((kind | 0o444, 0, 0, 1, 0, 0, size, time_s, time_s, time_s), exact)


def sizes(folder: Path) -> dict[str, int]:
    """Sizes of the files directly in a folder, by name, in one listing. FileNotFoundError where there is none."""
    if isinstance(folder, ObjectPath):
        return folder.sizes()
    with os.scandir(folder) as entries:
        return {entry.name: entry.stat().st_size for entry in entries if entry.is_file()}


def below(folder: Path) -> dict[str, int]:
    """Sizes of all files below a folder, by their paths from there."""
    if isinstance(folder, ObjectPath):
        return folder.below()
    found = dict[str, int]()
    for file in (Path(parent) / name for parent, _, names in os.walk(folder) for name in names):
        with suppress(FileNotFoundError):  # it has gone meanwhile
            status = file.stat()
            if stat.S_ISREG(status.st_mode):
                found[file.relative_to(folder).as_posix()] = status.st_size
    return found


def source(file: Path) -> str | pa.NativeFile:
    """A file for pyarrow."""
    return file.source() if isinstance(file, ObjectPath) else str(file)


def located(paths: Iterable[str]) -> tuple[fs.FileSystem, list[str]]:
    """The file system of files that lie under one root, and their paths in it."""
    found = list(paths)
    prefix = f"{SCHEME}//"
    if not found or not found[0].startswith(prefix):
        return fs.LocalFileSystem(), found
    return store.file_system(), [path.removeprefix(prefix) for path in found]


def answers(path: Path, error: Exception | None = None) -> None:
    """StoreError where a path is in an object store that does not answer, or refuses.

    Also where a library's error says that it did not answer then.
    """
    if isinstance(path, ObjectPath):
        if error is not None and store.away(error):
            raise store.explained(error, path.bucket) from error
        with suppress(FileNotFoundError):
            path.stat()

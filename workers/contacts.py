"""The binding of workers/native/contacts.c, which finds the contacts of bars and triangles in place of Bullet."""

from __future__ import annotations

import ctypes
import struct
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path

import numpy as np

from t6gps.workers.bullet import pybullet

_EXPORTED = "b3InitStepSimulationCommand"
_TABLE = "_ZTV24btConvexTriangleCallback"
_FUNCTION = "_ZN24btConvexTriangleCallback15processTriangleEP9btVector3ii"
_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)
_SYMBOL_TABLE = 2


def library_path() -> Path | None:
    """The compiled functions beside this file, None if they were not built."""
    candidates = [Path(__file__).with_name(f"_contacts{suffix}") for suffix in EXTENSION_SUFFIXES]
    return next((candidate for candidate in candidates if candidate.exists()), None)


@cache
def take_over() -> bool:
    """Put the compiled functions in the place of Bullet's, for every client of this process.

    False where it cannot be done: they were not built, or this build of pybullet is not the one they were made for.
    """
    path = library_path()
    values = _symbols(Path(pybullet.__file__), [_EXPORTED, _TABLE, _FUNCTION])
    if path is None or len(values) < 3:
        return False
    exported = ctypes.cast(getattr(ctypes.CDLL(pybullet.__file__), _EXPORTED), ctypes.c_void_p).value
    base = (exported or 0) - values[_EXPORTED]
    install = ctypes.CDLL(str(path)).take_over
    install.argtypes = [ctypes.c_size_t, ctypes.c_size_t]
    return bool(install(base + values[_TABLE], base + values[_FUNCTION]))


def _symbols(library: Path, names: list[str]) -> dict[str, int]:
    """Values of those of `names` that the symbol table of an ELF file of 64 bits holds."""
    content = np.memmap(library, np.uint8, mode="r")
    header = content[:64].tobytes()
    if header[:6] != b"\x7fELF\x02\x01":
        return {}
    (start,) = struct.unpack_from("<Q", header, 0x28)
    size, count, _ = struct.unpack_from("<HHH", header, 0x3A)
    sections = [struct.unpack("<IIQQQQIIQQ", content[start + i * size :][:64].tobytes()) for i in range(count)]
    values: dict[str, int] = {}
    for _, kind, _, _, offset, length, link, *_ in sections:
        if kind != _SYMBOL_TABLE:
            continue
        strings = content[sections[link][4] :][: sections[link][5]].tobytes()
        symbols = content[offset:][:length].view(_SYMBOL)
        for name in names:
            at = strings.find(b"\0" + name.encode() + b"\0") + 1
            if at and (symbols["name"] == at).any():
                values[name] = int(symbols["value"][symbols["name"] == at][0])
    return values

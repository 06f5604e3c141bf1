"""Compiled functions of ours in the place of virtual ones of Bullet: contacts (contacts.c) and solver (solver.c)."""

from __future__ import annotations

import ctypes
import struct
from functools import cache
from importlib.machinery import EXTENSION_SUFFIXES
from itertools import chain
from pathlib import Path

import numpy as np

from t6gps.workers.physics.bullet import pybullet

_EXPORTED = "b3InitStepSimulationCommand"
"""A function whose address the loader tells; the others lie at fixed distances from it."""

_OVERRIDES = {
    "contacts": (
        "override_triangles",
        "_ZTV24btConvexTriangleCallback",
        "_ZN24btConvexTriangleCallback15processTriangleEP9btVector3ii",
    ),
    "solver": (
        "override_iterations",
        "_ZTV27btMultiBodyConstraintSolver",
        "_ZN35btSequentialImpulseConstraintSolver33solveGroupCacheFriendlyIterationsEPP17btCollisionObjectiPP20"
        "btPersistentManifoldiPP17btTypedConstraintiRK19btContactSolverInfoP12btIDebugDraw",
    ),
}
"""By name: our function that installs it, and the symbols of Bullet's table of virtual functions and of the function
that is replaced."""

_ENTRIES_N = 32
"""Entries of a table that are looked through, as in native/override.c."""

_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)
_SYMBOL_TABLE = 2


def library_path() -> Path | None:
    """The compiled functions beside this file, None if they were not built."""
    candidates = [Path(__file__).with_name(f"_overrides{suffix}") for suffix in EXTENSION_SUFFIXES]
    return next((candidate for candidate in candidates if candidate.exists()), None)


@cache
def take_over() -> bool:
    """Install the overrides, for every client of this process.

    False where it cannot be done: they were not built, or this build of pybullet is not the one they were made for.
    """
    path, addresses = library_path(), _addresses()
    if path is None or not addresses:
        return False
    library = ctypes.CDLL(str(path))
    return all(
        library[install](ctypes.c_void_p(addresses[table]), ctypes.c_void_p(addresses[function]))
        for install, table, function in _OVERRIDES.values()
    )


def active() -> dict[str, bool]:
    """Whether each override is in place in this process, as Bullet's own tables say."""
    addresses = _addresses()
    if not addresses:
        return dict.fromkeys(_OVERRIDES, False)
    tables = {
        name: (ctypes.c_size_t * _ENTRIES_N).from_address(addresses[table])
        for name, (_, table, _) in _OVERRIDES.items()
    }
    return {name: addresses[function] not in tables[name] for name, (_, _, function) in _OVERRIDES.items()}


@cache
def _addresses() -> dict[str, int]:
    """Addresses of Bullet's tables and functions in this process, none if its library does not tell them all."""
    symbols = [_EXPORTED, *chain(*(pair for _, *pair in _OVERRIDES.values()))]
    values = symbol_values(Path(pybullet.__file__), symbols)
    if len(values) < len(symbols):
        return {}
    exported = ctypes.cast(getattr(ctypes.CDLL(pybullet.__file__), _EXPORTED), ctypes.c_void_p).value or 0
    return {symbol: exported - values[_EXPORTED] + value for symbol, value in values.items()}


def symbol_values(library: Path, names: list[str]) -> dict[str, int]:
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

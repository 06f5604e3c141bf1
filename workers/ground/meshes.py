"""Triangles of STL and OBJ files, read to the letter: a line that is not understood is refused, never passed over.

Readers of meshes are made to show something, so they skip what they do not understand. Ground with a part missing is
other ground. trimesh, for one, ends a list of numbers at the first word that is none, takes the vertex 0 for the first,
and counts negative vertices from the end of the file in place of the present line.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable, Iterator
from io import BytesIO, TextIOWrapper

import numpy as np
from numpy.typing import NDArray

from t6gps.storage.errors import TerrainError
from t6gps.workers.robot.state import Array

MOST_TRIANGLES_N = 250_000
"""On 40 m: one for every 8 cm."""

LARGEST_TEXT_BYTES = 8 * 2**20
"""Text is read a word at a time: so much takes a few seconds at most."""

STL_HEADER_BYTES = 84
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
STL_WORDS = b"facet normal 0 0 0 outer loop vertex 0 0 0 vertex 0 0 0 vertex 0 0 0 endloop endfacet".split()
"""A triangle of an ASCII STL; 0 stands for any number."""

OBJ_WITHOUT_SHAPE = frozenset(
    ("vt", "vn", "vp", "l", "p", "o", "g", "s", "mg", "usemtl", "mtllib", "usemap", "maplib", "lod", "bevel")
)
"""Statements of an OBJ that neither move nor make a triangle."""

SMALLEST_AREA_M2 = 1e-9
"""Seen from above, a triangle of less is upright: it turns neither way."""


def stl(content: bytes) -> Array:
    """Corners [m, 3, 3] (m) of the triangles of an STL, binary or ASCII. TerrainError unless it is whole."""
    is_text = content.lstrip()[:5].lower() == b"solid" and b"\0" not in content
    return _checked(_text_stl(content) if is_text else _binary_stl(content))


def _binary_stl(content: bytes) -> Array:
    if len(content) < STL_HEADER_BYTES:
        raise TerrainError(
            f"{len(content)} bytes are no STL: a binary one has a header of {STL_HEADER_BYTES}, an ASCII one starts "
            "with the word solid; export it anew"
        )
    claimed_n = int.from_bytes(content[STL_HEADER_BYTES - 4 : STL_HEADER_BYTES], "little")
    body = memoryview(content)[STL_HEADER_BYTES:]
    found_n = len(body) // STL_TRIANGLE.itemsize
    if found_n < claimed_n:
        raise TerrainError(f"the surface is truncated, {found_n} of {claimed_n} triangles are there; export it anew")
    if len(body) != claimed_n * STL_TRIANGLE.itemsize:
        raise TerrainError(f"{len(body)} bytes follow a header that announces {claimed_n} triangles; export it anew")
    with np.errstate(invalid="ignore"):  # what is no number is refused as such
        return np.asarray(np.frombuffer(body, STL_TRIANGLE)["corners"].astype(np.float64))


def _text_stl(content: bytes) -> Array:
    _check_text(content)
    words: list[bytes] = []
    last = b""
    for line in filter(None, map(bytes.strip, content.lower().splitlines())):
        last = line.split(maxsplit=1)[0]
        if last not in (b"solid", b"endsolid"):  # what follows these on their line is a name
            words += line.split()
    whole_n, rest_n = divmod(len(words), len(STL_WORDS))
    if rest_n or last != b"endsolid":
        raise TerrainError(f"the surface is truncated or garbled, it ends after {whole_n} triangles; export it anew")
    corners = array("d")
    for number in range(whole_n):
        triangle = words[number * len(STL_WORDS) : (number + 1) * len(STL_WORDS)]
        try:
            if any(word != expected for word, expected in zip(triangle, STL_WORDS, strict=True) if expected != b"0"):
                raise ValueError
            corners.extend(map(float, triangle[8:11] + triangle[12:15] + triangle[16:19]))
        except ValueError:
            found = b" ".join(triangle).decode("ascii", "replace")[:80]
            raise TerrainError(f"triangle {number + 1} cannot be read: {found!r}; export the surface anew") from None
    return np.frombuffer(corners).reshape(-1, 3, 3)


def obj(content: bytes) -> Array:
    """Corners [m, 3, 3] (m) of the faces of an OBJ, polygons cut into triangles. TerrainError unless all are read."""
    _check_text(content)
    vertices, faces, lines, firsts = array("d"), array("q"), array("q"), array("q")
    for number, (statement, *words) in _statements(content):
        try:
            if statement == "v":
                x, y, z = map(float, words[:3])
                vertices.extend((x, y, z))
            elif statement == "f":
                _check_count(len(faces) // 3 + len(words) - 2)
                polygon = [_vertex(word, len(vertices) // 3) for word in words]
                first, second, *others = polygon
                lines.append(number)
                firsts.append(len(faces) // 3)
                for third in others:
                    faces.extend((first, second, third))
                    second = third
                if not others:
                    raise ValueError
            elif statement not in OBJ_WITHOUT_SHAPE:
                raise ValueError
        except (ValueError, OverflowError):
            raise TerrainError(
                f"line {number} cannot be read: {' '.join([statement, *words])[:80]!r}; allowed are vertices (v) with "
                "three numbers and faces (f) of three or more vertices; export triangles anew"
            ) from None
    points, triangles = np.frombuffer(vertices).reshape(-1, 3), np.frombuffer(faces, np.int64).reshape(-1, 3)
    beyond = np.flatnonzero((triangles < 0) | (triangles >= len(points)))
    if len(beyond):
        line = lines[int(np.searchsorted(firsts, beyond[0] // 3, "right")) - 1]
        raise TerrainError(f"line {line} names a vertex that is not among the {len(points)} there are; export it anew")
    corners = _checked(points[triangles])
    _check_convex(corners, np.frombuffer(firsts, np.int64), lines)
    return corners


def _statements(content: bytes) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each line that says something; a backslash at its end goes on with the next line."""
    words: list[str] = []
    for number, line in enumerate(map(str.strip, TextIOWrapper(BytesIO(content), "utf-8-sig", errors="replace")), 1):
        if not line and not words:
            continue
        said = line.partition("#")[0].rstrip()
        words += said.rstrip("\\").split()
        if words and not said.endswith("\\"):
            yield number, words
            words = []
    if words:
        yield number, words


def _vertex(word: str, vertices_n: int) -> int:
    """Index of the vertex that VERTEX/TEXTURE/NORMAL names: from 1 on, or back from the newest one with -1."""
    number = int(word.partition("/")[0])
    return number - 1 if number > 0 else vertices_n + number if number < 0 else -1


def upward_areas(corners: Array) -> Array:
    """Areas [m] (m2) of triangles [m, 3, 3] seen from above, negative where corners run clockwise."""
    (ax, ay), (bx, by), (cx, cy) = (corners[:, k, :2].T for k in range(3))
    return np.asarray((bx - ax) * (cy - ay) - (by - ay) * (cx - ax)) / 2


def _check_convex(corners: Array, firsts: NDArray[np.int64], lines: Iterable[int]) -> None:
    """TerrainError for a polygon whose triangles around its first corner would reach beyond it."""
    areas = upward_areas(corners)
    lows, highs = np.minimum.reduceat(areas, firsts), np.maximum.reduceat(areas, firsts)
    for line, low, high in zip(lines, lows, highs, strict=True):
        if low < -SMALLEST_AREA_M2 and high > SMALLEST_AREA_M2:
            raise TerrainError(
                f"the polygon of line {line} is not convex seen from above, and can be cut into triangles in more than "
                "one way; triangulate the surface"
            )


def _check_text(content: bytes) -> None:
    if len(content) > LARGEST_TEXT_BYTES:
        raise TerrainError(
            f"the file holds more than {LARGEST_TEXT_BYTES // 2**20} MiB, the most that is read as text; export a "
            "binary .stl, or simplify the surface"
        )


def _check_count(triangles_n: int) -> None:
    if triangles_n > MOST_TRIANGLES_N:
        raise TerrainError(
            f"the surface has {triangles_n} triangles or more; allowed: up to {MOST_TRIANGLES_N}; simplify it, since "
            "the grid of the ground is coarser"
        )


def _checked(corners: Array) -> Array:
    """The corners, TerrainError where there are none, too many, or some that are not finite."""
    if not len(corners):
        raise TerrainError("the file holds no triangles; export a triangulated surface")
    _check_count(len(corners))
    broken = np.flatnonzero(~np.isfinite(corners).all(axis=(1, 2)))
    if len(broken):
        raise TerrainError(
            f"{len(broken)} of {len(corners)} triangles are not finite, the first is number {broken[0] + 1}; "
            "repair the surface"
        )
    return corners

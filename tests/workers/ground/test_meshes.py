"""Laws of triangulated surfaces: read whole and to the letter, or refused with the cause."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.meshes import obj, stl
from t6gps.workers.ground.surface import load
from t6gps.workers.ground.terrain import generate

HILLS = trimesh.Trimesh(*generate(4, 1.0, 10.0).triangles(), process=False)

TWO_OBJECTS = b"""o Hill
v -4 -4 0
v 4 -4 0
v 4 4 0
v -4 4 0
v 0 0 1
f -5 -4 -1
f -4 -3 -1
f -3 -2 -1
f -2 -5 -1
o Ground
v -20 -20 0
v 20 -20 0
v 20 20 0
v -20 20 0
f -4 -3 -2 -1
"""

SQUARE = b"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def text_stl() -> bytes:
    return HILLS.export(file_type="stl_ascii").encode()  # type: ignore[union-attr]


def binary_stl(corners: np.ndarray = HILLS.triangles) -> bytes:
    content = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    return bytes(content.export(file_type="stl"))


@pytest.mark.parametrize("content", [binary_stl(), text_stl(), text_stl().upper(), text_stl().replace(b"\n", b"\r\n")])
def test_both_forms_of_stl_hold_the_same_triangles(content: bytes) -> None:
    assert np.allclose(stl(content), HILLS.triangles, atol=1e-6)


def test_a_binary_stl_may_begin_like_an_ascii_one() -> None:
    assert len(stl(b"solid" + binary_stl()[5:])) == len(HILLS.faces)


def test_a_text_may_hold_several_solids() -> None:
    assert len(stl(text_stl() + text_stl())) == 2 * len(HILLS.faces)


def test_negative_vertices_count_back_from_their_own_line(tmp_path: Path) -> None:
    path = tmp_path / "hill.obj"
    path.write_bytes(TWO_OBJECTS)
    ground = load(path, 40.0, 1.55)
    assert ground.height(2.0, 0.0) == 0.5
    assert ground.height(10.0, 10.0) == 0.0


@pytest.mark.parametrize(
    "faces",
    [
        b"f 1 2 3\nf 1 3 4\n",
        b"f 1 2 3 4\n",
        b"f 1/7 2/8 3/9 4/10\n",
        b"f 1//5 2//5 3//5 4//5 # a quad\n",
        b"f 1 2 \\\n3 4\n",
        b"g side\nusemtl grass\ns off\nf -4 -3 -2 -1\n",
    ],
)
def test_every_way_to_write_a_square_gives_its_two_triangles(faces: bytes) -> None:
    square = [[[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 0, 0], [1, 1, 0], [0, 1, 0]]]
    assert obj(b"# made by hand\n" + SQUARE + b"vn 0 0 1\n" + faces).tolist() == square


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (SQUARE, "no triangles"),
        (SQUARE + b"f 1 2 9\n", "line 5 names a vertex that is not among the 4"),
        (SQUARE + b"f 1 2 0\n", "line 5 names a vertex"),
        (SQUARE + b"f 1 2 3\nf 1 2 -5\n", "line 6 names a vertex"),
        (SQUARE + b"f 1 2\n", "line 5 cannot be read: 'f 1 2'"),
        (SQUARE + b"f 1 2 x\n", "line 5 cannot be read"),
        (SQUARE + b"f 1 2 99999999999999999999\n", "line 5 cannot be read"),
        (SQUARE + b"v 1 2\nf 1 2 3\n", "line 5 cannot be read: 'v 1 2'"),
        (SQUARE + b"w 1 2 3\nf 1 2 3\n", "line 5 cannot be read: 'w 1 2 3'"),
        (SQUARE + b"v nan 0 0\nf 1 2 5\n", "1 of 1 triangles are not finite"),
        (SQUARE + b"v 0.5 0.2 0\nf 1 5 2 3\n", "polygon of line 6 is not convex"),
        (b"v 0 0 0\nf" + 250_003 * b" 1" + b"\n", "has 250001 triangles or more; allowed: up to 250000"),
    ],
)
def test_an_obj_with_a_line_that_is_not_understood_is_refused(content: bytes, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        obj(content)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (binary_stl()[:60], "60 bytes are no STL"),
        (binary_stl()[:-777], "truncated, 784 of 800 triangles"),
        (binary_stl() + b"more", "bytes follow a header that announces 800 triangles"),
        (binary_stl(HILLS.triangles[:0]), "no triangles"),
        (binary_stl(np.where(np.arange(800)[:, None, None] == 46, np.nan, HILLS.triangles)), "1 of 800.*number 47"),
        (text_stl()[:-777], "truncated or garbled, it ends after 79[0-9] triangles"),
        (text_stl().replace(b"vertex", b"vertices", 1), "triangle 1 cannot be read: 'facet normal"),
        (text_stl().replace(b"vertex ", b"vertex 1x", 4), "triangle 1 cannot be read"),
        (b"solid empty\nendsolid empty\n", "no triangles"),
    ],
)
def test_an_stl_that_is_not_whole_is_refused(content: bytes, words: str) -> None:
    with pytest.raises(TerrainError, match=words):
        stl(content)

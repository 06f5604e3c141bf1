"""Height maps as numpy arrays and as pictures. What a file claims is checked before anything is read or decoded.

`check` takes the claimed shape and raises TerrainError where it is none of a ground.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from io import BytesIO
from math import prod

import numpy as np
from PIL import Image

from t6gps.storage.errors import TerrainError
from t6gps.workers.robot.state import Array

Check = Callable[[tuple[int, ...]], None]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_SIZE_OFFSET = 16
"""Where width and height lie in the header that opens every PNG."""

WHITES = {"L": 255.0, "I;16": 65535.0, "I": 65535.0}
"""Largest value by Pillow's modes of grey pictures."""

_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


def npy(content: bytes, check: Check) -> Array:
    """Heights (m) of an .npy file, as they are. TerrainError unless it holds one whole array of real numbers."""
    if content[:2] == b"PK":
        raise TerrainError("this is an archive of arrays (.npz); save one array with numpy.save")
    file = BytesIO(content)
    version = np.lib.format.read_magic(file)
    if version not in _HEADERS:
        raise TerrainError(f"version {version} of .npy has no plain numbers; save real numbers with numpy.save")
    shape, _, dtype = _HEADERS[version](file)
    if dtype.kind not in "iuf":
        raise TerrainError(f"heights must be real numbers, found {dtype}; save heights (m) with numpy.save")
    check(shape)
    claimed_n, found_n = prod(shape) * dtype.itemsize, len(content) - file.tell()
    if claimed_n != found_n:
        raise TerrainError(f"{list(shape)} heights take {claimed_n} bytes, found {found_n}; save it anew")
    heights = np.load(BytesIO(content), allow_pickle=False)
    with np.errstate(invalid="ignore", over="ignore"):  # what is no number afterwards is refused as such
        return np.asarray(heights.astype(np.float64))


def png(content: bytes, check: Check, range_m: float) -> Array:
    """Heights (m) of a grey picture, black at 0 and white at `range_m`. TerrainError unless it is whole and grey."""
    if not content.startswith(PNG_SIGNATURE):
        raise TerrainError("this is not a picture in the format PNG; save it as a grey PNG")
    check(struct.unpack_from(">II", content, PNG_SIZE_OFFSET))
    with Image.open(BytesIO(content)) as image:
        image.verify()  # checksums, which decoding does not look at
    with Image.open(BytesIO(content)) as image:
        if image.mode not in WHITES:
            raise TerrainError(f"a height map must be grey with 8 or 16 bits, found mode {image.mode}; convert it")
        grey = np.asarray(image, dtype=np.float64)
    return np.ascontiguousarray(grey[::-1].T) * (range_m / WHITES[image.mode])

"""Mutated files of ground: `python tests/workers/ground/fuzz.py N`, N of each kind, or `make fuzz` with 2,000.

Each file must give finite heights, or one TerrainError of one line that names the file and is not about memory, within
LONGEST_S of processor time, and so must a few whole files at the bounds of what is read. Prints how many gave which
answer, the longest time and the largest memory of this process, and exits with 1 where the law is broken. Files of the
same N are the same: everything is drawn from one seed.
"""

from __future__ import annotations

import io
import re
import resource
import struct
import sys
import tempfile
import time
import warnings
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from t6gps.storage.errors import TerrainError
from t6gps.workers.ground.draping import MOST_VISITS_N
from t6gps.workers.ground.meshes import LARGEST_TEXT_BYTES, MOST_TRIANGLES_N
from t6gps.workers.ground.sense import FINEST_CELL_M
from t6gps.workers.ground.surface import LARGEST_FILE_BYTES, load
from t6gps.workers.ground.terrain import CELL_M, Terrain, generate

Rng = np.random.Generator

SEED = 0
SIZE_M = 34.0
LONGEST_S = 5.0
LARGEST_MB = 500.0

NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:e[-+]?\d+)?")
ODD_WORDS = (b"nan", b"-inf", b"1e300", b"-1e-300", b"0", b"-1", b"99999999999999999999", b"x", b"", b"1_0", b"\xff")
ODD_BYTES = tuple(struct.pack("<f", x) for x in (np.nan, np.inf, -3e38, 1e-40)) + (b"\xff" * 4, b"\0" * 4, b"\x7f" * 4)


def _saved(save: Callable[[io.BytesIO], object]) -> bytes:
    file = io.BytesIO()
    save(file)
    return file.getvalue()


def originals() -> dict[str, list[bytes]]:
    """Good files of each kind, by suffix."""
    terrain = generate(4, 1.0, SIZE_M)
    grey = 255 * (terrain.heights - terrain.heights.min()) / np.ptp(terrain.heights)
    pictures = [grey.astype(np.uint8), (257 * grey).astype(np.uint16)]
    mesh = trimesh.Trimesh(*Terrain(terrain.heights[::4, ::4], 2.0).triangles(), process=False)
    quads = b"o ground\nv 0 0 0\nv 40 0 0\nv 40 40 1\nv 0 40 1\nf -4/1/1 -3/1/1 -2/1/1 -1/1/1\n"
    return {
        ".npy": [
            _saved(lambda file: np.save(file, terrain.heights)),
            _saved(lambda file: np.save(file, np.asfortranarray(terrain.heights.astype(">f4")))),
            _saved(lambda file: np.save(file, grey.astype(np.int16) // 64)),
        ],
        ".png": [
            _saved(lambda file, p=p, level=level: Image.fromarray(p).save(file, "PNG", compress_level=level))  # type: ignore[misc]
            for p in pictures
            for level in (0, 6)
        ],
        ".stl": [mesh.export(file_type="stl"), mesh.export(file_type="stl_ascii").encode()],
        ".obj": [mesh.export(file_type="obj").encode(), quads],
    }


def flip(content: bytes, rng: Rng) -> bytes:
    """One to sixteen bits turned."""
    mutated = bytearray(content)
    for place in rng.integers(len(mutated), size=rng.integers(1, 17)):
        mutated[place] ^= 1 << int(rng.integers(8))
    return bytes(mutated)


def flip_early(content: bytes, rng: Rng) -> bytes:
    """Bits turned among the first 128 bytes, where headers lie."""
    return flip(content[:128], rng) + content[128:]


def cut(content: bytes, rng: Rng) -> bytes:
    """The end is missing."""
    return content[: int(rng.integers(len(content)))]


def drop(content: bytes, rng: Rng) -> bytes:
    """A piece is missing."""
    first, last = sorted(rng.integers(len(content), size=2))
    return content[:first] + content[last:]


def repeat(content: bytes, rng: Rng) -> bytes:
    """A piece comes twice, somewhere else."""
    first, last, place = sorted(rng.integers(len(content), size=3))
    return content[:place] + content[first:last] + content[place:]


def noise(content: bytes, rng: Rng) -> bytes:
    """A piece is noise."""
    place, width = int(rng.integers(len(content))), int(rng.integers(1, 200))
    return content[:place] + rng.bytes(width) + content[place + width :]


def odd_word(content: bytes, rng: Rng) -> bytes:
    """A number that is written in the file is another one, or none."""
    found = list(NUMBER.finditer(content[:20000]))
    if not found:
        return flip(content, rng)
    number = found[int(rng.integers(len(found)))]
    return content[: number.start()] + ODD_WORDS[int(rng.integers(len(ODD_WORDS)))] + content[number.end() :]


def odd_bytes(content: bytes, rng: Rng) -> bytes:
    """Four bytes that are no usual number."""
    place = 4 * int(rng.integers(len(content) // 4))
    return content[:place] + ODD_BYTES[int(rng.integers(len(ODD_BYTES)))] + content[place + 4 :]


MUTATIONS = (flip, flip_early, cut, drop, repeat, noise, odd_word, odd_bytes)


def with_true_checksums(content: bytes) -> bytes:
    """The PNG with a true checksum in each chunk, so that what it holds is looked at."""
    done, place = content[:8], 8
    while place + 12 <= len(content):
        (length,) = struct.unpack_from(">I", content, place)
        chunk = content[place + 4 : place + 8 + length]
        done += content[place : place + 4] + chunk + struct.pack(">I", zlib.crc32(chunk))
        place += 12 + length
    return done


def mutated(content: bytes, suffix: str, rng: Rng) -> bytes:
    """The content after one to three mutations, never empty."""
    for _ in range(int(rng.integers(1, 4))):
        content = MUTATIONS[int(rng.integers(len(MUTATIONS)))](content, rng) or b"\0"
    return with_true_checksums(content) if suffix == ".png" and rng.random() < 0.5 else content


def answer(path: Path) -> tuple[str, bool]:
    """What a file gives, in words without its numbers, and whether that follows the law."""
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        try:
            heights = load(path, SIZE_M, 1.55).heights
        except TerrainError as error:
            text = str(error)
            lawful = str(path) in text and "\n" not in text and len(text) < 600
            lawful &= not isinstance(error.__cause__, MemoryError)
            words = text.replace(str(path), "").removeprefix(": ").partition(";")[0]
            kind = re.sub(r"[-+]?\d[\d.e+-]*|\bnan\b|-?\binf\b", "#", words).partition(": ")[0][:90]
        except Exception as error:
            kind, lawful = f"{type(error).__name__} ESCAPES", False
        else:
            kind, lawful = "heights", bool(np.isfinite(heights).all() and heights.shape[0] == heights.shape[1])
    return (kind, lawful) if not warned else (f"{kind} WITH A WARNING", False)


def largest_memory_mb() -> float:
    """Largest resident memory of this process so far (MB)."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1000


def heaviest() -> dict[str, bytes]:
    """Files at the bounds of what is read, by name: as many triangles, layers, words, lines and heights as may be."""
    n = int((MOST_TRIANGLES_N / 2) ** 0.5)
    many = trimesh.Trimesh(*Terrain(np.zeros((n + 1, n + 1)), SIZE_M / n).triangles(), process=False)
    facet = b"facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
    square = b"v -20 -20 0\nv 20 -20 0\nv 20 20 0\nv -20 20 0\n"
    layers_n = MOST_VISITS_N // (2 * round(SIZE_M / CELL_M + 1) ** 2)
    finest = np.zeros((round(SIZE_M / FINEST_CELL_M) + 1,) * 2)
    return {
        "triangles.stl": many.export(file_type="stl"),
        "facets.stl": b"solid\n" + LARGEST_TEXT_BYTES // len(facet) * facet + b"endsolid",
        "lines.stl": b"solid" + (LARGEST_TEXT_BYTES - 20) * b"\n" + b"endsolid",
        "words.stl": b"solid\n" + (LARGEST_TEXT_BYTES // 2 - 20) * b"x " + b"\nendsolid",
        "layers.obj": square + layers_n * b"f 1 2 3 4\n",
        "faces.obj": square + MOST_TRIANGLES_N * b"f 1 2 3\n",
        "polygon.obj": square + b"f" + (LARGEST_TEXT_BYTES // 2 - 50) * b" 1",
        "lines.obj": LARGEST_TEXT_BYTES * b"\n",
        "vast.stl": (LARGEST_FILE_BYTES + 1) * b"\0",
        "finest.npy": _saved(lambda file: np.save(file, finest.astype(np.longdouble))),
        "finest.png": _saved(lambda file: Image.fromarray(finest.astype(np.uint16)).save(file, "PNG")),
    }


def judged(path: Path, content: bytes) -> tuple[str, float, list[str]]:
    """What a file of this content gives, the processor time (s), and what of that breaks the law."""
    path.write_bytes(content)
    start_s = time.process_time()
    kind, lawful = answer(path)
    taken_s = time.process_time() - start_s
    path.unlink()
    return kind, taken_s, [] if lawful and taken_s < LONGEST_S else [f"{path.name}: {kind}, {taken_s:.1f} s"]


def main(files_n: int) -> int:
    """Read so many mutated files of each kind and the heaviest ones, print the answers, return the exit status."""
    resource.setrlimit(resource.RLIMIT_AS, (2 * 10**9, 2 * 10**9))
    rng = np.random.default_rng(SEED)
    broken, longest_s = [], 0.0
    with tempfile.TemporaryDirectory() as folder:
        for suffix, goods in originals().items():
            answers: Counter[str] = Counter()
            for number in range(files_n):
                content = mutated(goods[number % len(goods)], suffix, rng)
                kind, taken_s, wrong = judged(Path(folder) / f"{number}{suffix}", content)
                answers[kind] += 1
                longest_s = max(longest_s, taken_s)
                broken += wrong
            print(
                f"{suffix}: {answers['heights']} of {files_n} gave heights, {files_n - answers['heights']} were refused"
            )
            for kind, count in answers.most_common():
                print(f"{count:8d}  {kind}")
        for name, content in heaviest().items():
            kind, taken_s, wrong = judged(Path(folder) / name, content)
            print(f"{name}, {len(content) / 1e6:.1f} MB: {kind}, {taken_s:.2f} s")
            longest_s = max(longest_s, taken_s)
            broken += wrong
    memory_mb = largest_memory_mb()
    print(f"longest {longest_s:.2f} s, largest memory {memory_mb:.0f} MB, {len(broken)} answers against the law")
    print(*broken, sep="\n", end="\n" if broken else "")
    return int(bool(broken) or memory_mb > LARGEST_MB)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))

"""OpenSubdiv's surfaces, at the parameters of this project.

``python tests/peers/peers.py`` compiles the program that answers, and prints where it is. It is kept in the user's
cache, by a hash of everything it is made from.
"""

import contextlib
import functools
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mitsuba_subdivision.figures.peers import as_bytes, from_bytes
from numpy.typing import ArrayLike, NDArray

SOURCES = [Path(__file__).with_name(name) for name in ("osd_peer.cpp", "peer_common.h")]
# The answers take milliseconds, and compiling OpenSubdiv's headers with -O3 three times as long as with -O1.
FLAGS = ["-std=c++17", "-O1", "-DNDEBUG", "-pthread"]
# Corners of a face that has one domain.
REGULAR_SIZE = {"catmark": 4, "loop": 3}
LEVELS = {"far": 10, "refine": 6}


class PeerError(RuntimeError):
    """OpenSubdiv's program is missing, or did not answer."""


@functools.cache
def find() -> Path | str:
    """Path of the program, compiled if it is not yet; or, in words, why there is none."""
    compiler = shutil.which("g++")
    if compiler is None:
        return "no compiler g++"
    made_from = b"\0".join([*(path.read_bytes() for path in SOURCES), *map(str.encode, FLAGS)])
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsuba-subdivision" / "peers"
    program = cache / hashlib.sha256(made_from).hexdigest()[:16] / "osd_peer"
    if program.exists():
        return program
    program.parent.mkdir(parents=True, exist_ok=True)
    with (program.parent / "lock").open("w") as lock, tempfile.TemporaryDirectory(dir=cache) as beside:
        with contextlib.suppress(ImportError):  # On Windows.
            import fcntl

            # Other processes that run tests wait for what this one compiles.
            fcntl.flock(lock, fcntl.LOCK_EX)
        if program.exists():
            return program
        new, link = Path(beside) / "new", Path(beside) / "link"
        command = [compiler, *FLAGS, str(SOURCES[0]), "-o", str(new), "-losdCPU"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            wrong = [line for line in done.stderr.splitlines() if "error" in line or "cannot find" in line]
            return f"{SOURCES[0].name} does not compile: {(wrong or ['g++ failed'])[0]}"
        new.replace(program)
        # A name that figures know leads to the program that was compiled last.
        link.symlink_to(program)
        link.replace(cache / program.name)
    return program


@dataclass(frozen=True, eq=False)
class PeerCage:
    """A control cage with the names that OpenSubdiv has for its options."""

    positions: ArrayLike  # (n_v, 3)
    faces: Sequence[Sequence[int]]
    scheme: str = "catmark"  # | "loop"
    boundary: str = "edge_and_corner"  # | "edge_only" | "none"
    creases: Sequence[tuple[int, int, float]] = ()  # (vertex, vertex, sharpness)
    corners: Sequence[tuple[int, float]] = ()  # (vertex, sharpness)
    holes: Sequence[int] = ()  # Faces.
    creasing: str = "uniform"  # | "chaikin"
    triangles: str = "catmark"  # | "smooth"
    # (n, width) values, and one index of them per corner of all faces, one after the other.
    fvar: tuple[ArrayLike, ArrayLike] | None = None
    fvar_linear: str = "all"  # | "none" | "boundaries" | "corners_only" | "corners_plus1" | "corners_plus2"


class PeerSamples(NamedTuple):
    """Samples of OpenSubdiv's surface; not a number where it has none."""

    p: NDArray[np.float64]  # (s, 3)
    # (s, 3) derivatives by the sample's own (u, v); by "refine", two tangents of other directions.
    du: NDArray[np.float64]
    dv: NDArray[np.float64]
    fvar: NDArray[np.float64]  # (s, width)
    # (s,); by "refine", the refined vertex at the sample, and its rule: 1 smooth, 2 dart, 4 crease, 8 corner.
    vertex: NDArray[np.int32]
    rule: NDArray[np.int32]

    @property
    def n(self) -> NDArray[np.float64]:
        """Unit normals, ``(s, 3)``; not a number where there are none."""
        cross = np.cross(self.du, self.dv)
        with np.errstate(invalid="ignore"):
            return cross / np.linalg.norm(cross, axis=1, keepdims=True)


def evaluate(
    cage: PeerCage,
    element: ArrayLike,
    uv: ArrayLike,
    corner: ArrayLike = 0,
    *,
    method: str = "far",
    level: int | None = None,
) -> PeerSamples:
    """Samples of a cage's limit surface; ``element``, ``uv`` and ``corner`` as for `LimitSurface.evaluate`.

    The method is "far", patch tables after adaptive refinement, or "refine", uniform refinement and limit masks, which
    know vertices of the level only. Levels of refinement are 10 for "far", which can no more, and 6 for "refine".
    """
    program = find()
    if not isinstance(program, Path):
        raise PeerError(program)
    sizes = np.array([len(face) for face in cage.faces])
    element, corner, u, v = np.broadcast_arrays(element, corner, *np.moveaxis(np.asarray(uv, dtype=float), -1, 0))
    element, corner, uv = element.ravel(), corner.ravel(), np.stack([u.ravel(), v.ravel()], axis=1)
    size = REGULAR_SIZE[cage.scheme]
    is_whole = sizes[element] == size
    turned, back = _from_corner_0(size, uv, np.where(is_whole, corner, 0))

    values, indices = cage.fvar if cage.fvar is not None else (np.zeros((0, 0)), [])
    values, positions = np.asarray(values, dtype=float), np.asarray(cage.positions, dtype=float)
    records = {
        "widths": np.array([3, values.shape[1]], dtype=np.int32),
        "values": positions,
        "sizes": sizes.astype(np.int32),
        "corners": np.concatenate([np.asarray(face, dtype=np.int32) for face in cage.faces]),
        "creases": np.array([crease[:2] for crease in cage.creases], dtype=np.int32),
        "edge_sharpness": np.array([crease[2] for crease in cage.creases], dtype=float),
        "sharp_vertices": np.array([vertex for vertex, _ in cage.corners], dtype=np.int32),
        "point_sharpness": np.array([sharpness for _, sharpness in cage.corners], dtype=float),
        "holes": np.array(cage.holes, dtype=np.int32),
        "fvar_values": values,
        "fvar_indices": np.asarray(indices, dtype=np.int32),
        "face": element.astype(np.int32),
        "sub": np.where(is_whole, 0, corner).astype(np.int32),
        "uv": turned,
    }
    options = {"method": method, "level": LEVELS[method] if level is None else level}
    options |= {"scheme": cage.scheme, "boundary": cage.boundary, "creasing": cage.creasing}
    options |= {"triangles": cage.triangles, "fvar": cage.fvar_linear}
    with tempfile.TemporaryDirectory() as folder:
        queries, answers = Path(folder, "queries"), Path(folder, "answers")
        queries.write_bytes(as_bytes(records))
        words = [word for name, value in options.items() for word in (f"--{name}", str(value))]
        done = subprocess.run([program, queries, answers, *words], capture_output=True, text=True, check=False)
        if done.returncode:
            raise PeerError(f"{program.name} fails: {done.stderr.strip() or done.returncode}")
        answer = from_bytes(answers.read_bytes())
    p, du, dv = (answer[name].reshape(-1, 3) for name in ("p", "du", "dv"))
    if method != "refine":
        du, dv = (back[:, i, :1] * du + back[:, i, 1:] * dv for i in (0, 1))
    fvar = answer["fvar"].reshape(len(element), values.shape[1])
    return PeerSamples(p, du, dv, fvar, answer["vertex"], answer["rule"])


def _from_corner_0(size: int, uv: NDArray, corner: NDArray) -> tuple[NDArray, NDArray]:
    """Parameters counted from a face's corner 0, and their derivatives by the given ones: ``(s, 2, 2)``, row by u."""
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1]] if size == 4 else [[0, 0], [1, 0], [0, 1]], dtype=float)
    origin, along_u, along_v = corners[corner], corners[(corner + 1) % size], corners[corner - 1]
    matrix = np.stack([along_u - origin, along_v - origin], axis=1)
    return origin + np.einsum("si,sij->sj", uv, matrix), matrix


if __name__ == "__main__":
    sys.stdout.write(f"{find()}\n")

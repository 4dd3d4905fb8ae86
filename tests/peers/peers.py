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
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mitsuba_subdivision import ControlCage
from mitsuba_subdivision.figures.peers import as_bytes, from_bytes
from numpy.typing import ArrayLike, NDArray

SOURCES = [Path(__file__).with_name(name) for name in ("osd_peer.cpp", "peer_common.h")]
# The answers take milliseconds, and compiling OpenSubdiv's headers with -O3 three times as long as with -O1.
FLAGS = ["-std=c++17", "-O1", "-DNDEBUG", "-pthread"]
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
    cage: ControlCage,
    element: ArrayLike,
    uv: ArrayLike,
    corner: ArrayLike = 0,
    *,
    method: str = "far",
    level: int | None = None,
    faces: list[list[int]] | None = None,  # In place of the cage's.
) -> PeerSamples:
    """Samples of a cage's limit surface; ``element``, ``uv`` and ``corner`` as for `LimitSurface.evaluate`.

    The method is "far", patch tables after adaptive refinement, or "refine", uniform refinement and limit masks, which
    know vertices of the level only. Levels of refinement are 10 for "far", which can no more, and 6 for "refine".
    """
    program = find()
    if not isinstance(program, Path):
        raise PeerError(program)
    element, corner, u, v = np.broadcast_arrays(element, corner, *np.moveaxis(np.asarray(uv, dtype=float), -1, 0))
    element, corner, uv = element.ravel(), corner.ravel(), np.stack([u.ravel(), v.ravel()], axis=1)
    size = 3 if cage.scheme == "loop" else 4
    is_whole = cage.face_sizes[element] == size
    turned, back = _from_corner_0(size, uv, np.where(is_whole, corner, 0))
    creases, corners, texcoords = cage.tags.creases(cage.topology), cage.tags.corners(), cage.texcoords
    values, indices = (np.zeros((0, 0)), []) if texcoords is None else (texcoords.values, texcoords.indices)
    integers = {
        "widths": [3, values.shape[1]],
        "sizes": cage.face_sizes,
        "corners": cage.face_vertices if faces is None else np.concatenate(faces),
        "creases": creases[:, :2],
        "sharp_vertices": corners[:, 0],
        "holes": cage.holes,
        "fvar_indices": indices,
        "face": element,
        "sub": np.where(is_whole, 0, corner),
    }
    floats = {
        "values": cage.positions,
        "edge_sharpness": creases[:, 2],
        "point_sharpness": corners[:, 1],
        "fvar_values": values,
        "uv": turned,
    }
    records = {name: np.array(numbers, dtype=np.int32) for name, numbers in integers.items()} | floats
    options = {"method": method, "level": LEVELS[method] if level is None else level}
    options |= {"scheme": "loop" if size == 3 else "catmark", "boundary": cage.boundary, "fvar": cage.face_varying}
    options |= {"creasing": cage.crease_method, "triangles": cage.triangle_rule.replace("catmull_clark", "catmark")}
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

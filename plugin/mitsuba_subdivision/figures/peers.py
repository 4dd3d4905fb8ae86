"""Surfaces of OpenSubdiv and Blender, computed by programs, for figures that compare with them.

``python tests/peers/peers.py`` compiles OpenSubdiv's program, `osd_peer`. Without a program, figures omit its surface.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..cage import ControlCage
from ..messages import print_remark
from .output import FigureError

# Header of an array: name, type and number of values.
_HEADER = np.dtype([("name", "S16"), ("type", "S8"), ("size", "<i8")])
VARIABLE = "MITSUBA_SUBDIVISION_PEERS"  # Environment variable for the folder of programs that are not on the path
BLENDER_SCRIPT = Path(__file__).with_name("blender_script.py")


def osd_peer() -> Path | None:
    """The program `osd_peer`: in the folder of `VARIABLE`, on the path, or last compiled by the tests."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "mitsuba-subdivision" / "peers"
    return _program("osd_peer", str(cache))


def blender() -> Path | None:
    """The program `blender`: in the folder of `VARIABLE`, or on the path."""
    return _program("blender")


def _program(name: str, *more: str) -> Path | None:
    folders = filter(None, (os.environ.get(VARIABLE), os.environ.get("PATH"), *more))
    path = shutil.which(name, path=os.pathsep.join(folders))
    if not path:
        print_remark(f'its picture is left out: no program "{name}" on the path or in the folder {VARIABLE}')
    return Path(path) if path else None


def osd_samples(
    program: Path, cage: ControlCage, element: ArrayLike, uv: ArrayLike, method: str, level: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points and unit normals ``(s, 3)`` of OpenSubdiv's Catmull-Clark surface in float32, its default precision.

    The cage has quads without tags; elements broadcast with parameters ``(s, 2)``. The method is "far", patch tables
    with isolation levels up to 10, or "bfr", surfaces of single faces with an approximation level. Normals are not a
    number where derivatives are parallel or zero.
    """
    element, u, v = np.broadcast_arrays(element, np.asarray(uv)[..., 0], np.asarray(uv)[..., 1])
    integers = {"widths": [3, 0], "sizes": cage.face_sizes, "corners": cage.face_vertices, "face": element}
    records: dict[str, NDArray] = {
        **{name: np.asarray(values, dtype=np.int32) for name, values in integers.items()},
        "sub": np.zeros(element.size, dtype=np.int32),
        "values": cage.positions,
        "uv": np.stack([u, v], axis=-1).astype(np.float64),
    }
    options = ["--method", method, "--level", str(level), "--real", "float"]
    answers = from_bytes(_answer(program, [], as_bytes(records), options))
    points, along_u, along_v = (answers[name].reshape(-1, 3) for name in ("p", "du", "dv"))
    cross = np.cross(along_u, along_v)
    with np.errstate(invalid="ignore"):
        return points, cross / np.linalg.norm(cross, axis=1, keepdims=True)


def blender_mesh(program: Path, cage: ControlCage, level: int) -> tuple[NDArray, NDArray, NDArray, str]:
    """Points and shading normals ``(n, 3)``, faces ``(m, 4)`` of Blender's modifier at a level; Blender's version."""
    # Several threads make the last bits of shared points random.
    options = ["--threads", "1", "--background", "--factory-startup", "--python-exit-code", "1"]
    options += ["--python", str(BLENDER_SCRIPT), "--"]
    arrays = {"positions": cage.positions, "sizes": cage.face_sizes, "corners": cage.face_vertices}
    query = json.dumps({name: values.tolist() for name, values in arrays.items()})
    answers = json.loads(_answer(program, options, query.encode(), [str(level)]))
    points, normals = (np.array(answers[name]).reshape(-1, 3) for name in ("p", "n"))
    quads = np.array(answers["corners"], dtype=np.int32).reshape(-1, 4)
    return points, normals, quads, "{}.{}".format(*answers["version"])


def _answer(program: Path, before: list[str], query: bytes, after: list[str]) -> bytes:
    """Run a program with an input file of these contents and an output file; return the output."""
    with tempfile.TemporaryDirectory() as folder:
        queries, answers = Path(folder, "queries"), Path(folder, "answers")
        queries.write_bytes(query)
        done = subprocess.run([program, *before, queries, answers, *after], capture_output=True, text=True, check=False)
        if done.returncode or not answers.exists():  # Blender may exit with 0 although its script failed
            raise FigureError(f"{program} fails: {done.stderr.strip() or done.returncode}")
        return answers.read_bytes()


def as_bytes(records: Mapping[str, NDArray]) -> bytes:
    """Arrays of int32 and float64 in the format of the peers' programs (``peer_common.h``)."""
    data = b""
    for name, values in records.items():
        kind = "i" if values.dtype == np.int32 else "d"
        data += np.array((name, kind, values.size), _HEADER).tobytes() + values.tobytes()
    return data


def from_bytes(data: bytes) -> dict[str, NDArray]:
    """Arrays in the format of `as_bytes`."""
    records: dict[str, NDArray] = {}
    while data:
        (name, kind, count), rest = np.frombuffer(data, _HEADER, 1)[0], data[_HEADER.itemsize :]
        values = records[name.decode()] = np.frombuffer(rest, np.int32 if kind == b"i" else np.float64, count)
        data = rest[values.nbytes :]
    return records

"""Adaptive tessellations of models, against uniform ones in the same process.

python tests/benchmarks/adaptive.py MODEL.. [--schemes catmull_clark loop] [--errors 1 1e-3 outlines] [--distances]

For each model, scheme and error, in a process of its own: triangles, seconds of processor time, the least of three, and
the most memory that the process has taken beyond what it took before, once for a uniform tessellation and once for an
adaptive one whose triangles are no further from the surface than the error, in parts of the model's size. Both are
counted from prepared patches to points, normals and triangles; what uniform and adaptive have in common, as the classes
of patches, is made before. An error of 1 asks for the fewest triangles that the cage allows; "outlines" is what
pictures with exact shading ask for: outlines within a tenth of a pixel, where the model is 640 pixels large. A stage of
USD is tessellated mesh by mesh, and its rows are sums. With ``--distances``, the largest of triangles from the surface
and of the surface from the triangles follow, measured as in ``tests/tessellation/distances.py``, in parts of the error.
"""

import argparse
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.cage import cage_of
from mitsuba_subdivision.tessellation.criterion import Criterion, Sensor
from processes import ROOT, measured, peak_memory, print_row, run

OUTLINES = "outlines"
# Where distances are measured.
MOST_SEGMENTS = 1024


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL", help="OBJ, PLY or USD files")
    parser.add_argument("--schemes", nargs="+", default=["catmull_clark"])
    parser.add_argument("--errors", nargs="+", type=_error, default=[1.0, 1e-3, 1e-4, OUTLINES])
    parser.add_argument("--rate", type=int, default=1, help="of the uniform tessellation (default: 1)")
    parser.add_argument("--distances", action="store_true", help="measure distances in both directions, too")
    options = parser.parse_args()
    columns = ["faces", "uniform", "s", "MB", "adaptive", "s", "MB", "us/triangle"]
    print_row("model, scheme, error", *columns, *(["to surface", "from surface"] * options.distances), width=13)
    for model in options.models:
        for scheme in options.schemes:
            for error in options.errors:
                _show(model, scheme, error, options)


def _error(word):
    return word if word == OUTLINES else float(word)


def _show(model, scheme, error, options):
    uniform = measured(tessellations, model, scheme, None, options.rate)
    adaptive = measured(tessellations, model, scheme, error, None)
    beyond = adaptive["seconds"] - (2 * uniform["seconds"] if options.rate == 1 else 0)
    cells = [f"{adaptive['faces']:,}"]
    for side in (uniform, adaptive):
        cells += [f"{side['triangles']:,}", f"{side['seconds']:.2f}", f"{side['memory']:.0f}"]
    cells.append(f"{1e6 * max(0, beyond) / adaptive['triangles']:.2f}")
    if options.distances:
        away = measured(farthest, model, scheme, error)
        cells += [f"{away[name]:.3f}" for name in ("to surface", "from surface")]
    print_row(f"{model.name}, {scheme}, {error if error == OUTLINES else format(error, 'g')}", *cells, width=13)


def tessellations(_clock, model, scheme, error, rate):
    """Sums over all surfaces of a file, of adaptive tessellations where an error is given."""
    faces = triangles = seconds = memory = 0
    for cage in _cages(Path(model)):
        surface = LimitSurface(cage, scheme)
        # Classes are found once for all tessellations.
        assert surface.patches.classes
        taken, before = [], peak_memory()
        for _ in range(3):
            start = time.process_time()
            table = surface.sampling(rate) if error is None else surface.adaptive_sampling(_criterion(cage, error))
            table.apply(cage.positions)
            count = len(table.triangles)
            taken.append(time.process_time() - start)
            del table
        seconds += min(taken)
        triangles += count
        faces += cage.face_count
        memory += peak_memory() - before
    return {"faces": faces, "triangles": triangles, "seconds": seconds, "memory": memory}


def _criterion(cage, error):
    size = np.linalg.norm(np.ptp(cage.positions, axis=0))
    if error != OUTLINES:
        return Criterion("chord", error * size)
    distance, pixels = 2.0, 640
    eye = cage.positions.mean(axis=0) + distance * size * np.array([0.6, 0.48, 0.64])
    sensor = Sensor(eye, 1 / (distance * pixels))
    return Criterion("chord", 0.1, sensor, sensor)


def farthest(_clock, model, scheme, error):
    """How far triangles are from the surface, and the surface is from them, at most."""
    sys.path.append(str(ROOT / "tests"))
    from tessellation.distances import distances

    largest = np.zeros(2)
    for cage in _cages(Path(model)):
        surface, criterion = LimitSurface(cage, scheme), _criterion(cage, error)
        away = distances(surface, surface.adaptive_sampling(criterion, MOST_SEGMENTS))
        largest = np.maximum(largest, np.divide(away, criterion.error))
    return dict(zip(("to surface", "from surface"), largest.tolist(), strict=True))


def _cages(path):
    """Control cages of a file: one of a model, all limit surfaces of a stage, in the space of their points."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not path.suffix.startswith(".usd"):
            yield ControlCage.from_file(path)
            return
        from mitsuba_usd.stage_walk import StageReader

        for shape in StageReader(path, None).at(None).all_shapes:
            if shape.cage.scheme is not None:
                yield cage_of(shape.cage)


if __name__ == "__main__":
    run(main, tessellations, farthest)

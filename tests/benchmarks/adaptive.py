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
import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.tessellation.criterion import Criterion, Measure, Sensor
from processes import measured, peak_memory

OUTLINES = "outlines"
# Where distances are measured.
MOST_SEGMENTS = 1024
HEADER = "model, scheme, error         faces   uniform             s    MB   adaptive            s    MB   us/triangle"


def main(arguments=None):
    options = _parsed(arguments)
    if options.process:
        print(json.dumps(_measured(*json.loads(options.process))))
        return
    print(HEADER)
    for model in options.models:
        for scheme in options.schemes:
            for error in options.errors:
                print(_row(model, scheme, error, options.rate, options.distances), flush=True)


def _parsed(arguments):
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL", help="OBJ, PLY or USD files")
    parser.add_argument("--schemes", nargs="+", default=["catmull_clark"])
    parser.add_argument("--errors", nargs="+", type=_error, default=[1.0, 1e-3, 1e-4, OUTLINES])
    parser.add_argument("--rate", type=int, default=1, help="of the uniform tessellation (default: 1)")
    parser.add_argument("--distances", action="store_true", help="measure distances in both directions, too")
    parser.add_argument("--process", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def _error(word):
    return word if word == OUTLINES else float(word)


def _row(model, scheme, error, rate, has_distances):
    """One line of the table; each side is measured in a process of its own."""
    name = f"{model.name}, {scheme}, {error if error == OUTLINES else format(error, 'g')}"

    def of(kind):
        words = json.dumps([str(model), scheme, error, rate, kind])
        return measured(name, [sys.executable, __file__, "--process", words])

    uniform, adaptive = of("uniform"), of("adaptive")
    distances = " {triangles:8.3f} {surface:8.3f}".format(**of("distances")) if has_distances else ""
    columns = "".join("{triangles:10,} {seconds:12.2f} {memory:5.0f}   ".format(**side) for side in (uniform, adaptive))
    beyond = adaptive["seconds"] - 2 * uniform["seconds"] if rate == 1 else adaptive["seconds"]
    return f"{name:27} {adaptive['faces']:6,} {columns}{1e6 * max(0, beyond) / adaptive['triangles']:8.2f}{distances}"


def _criterion(cage, error):
    size = np.linalg.norm(np.ptp(cage.positions, axis=0))
    if error != OUTLINES:
        return Criterion(Measure.CHORD, error * size)
    distance, pixels = 2.0, 640
    eye = cage.positions.mean(axis=0) + distance * size * np.array([0.6, 0.48, 0.64])
    sensor = Sensor(eye, 1 / (distance * pixels))
    return Criterion(Measure.CHORD, 0.1, sensor, sensor)


def _measured(model, scheme, error, rate, kind):
    if kind == "distances":
        return _distances(model, scheme, error)
    faces = triangles = seconds = memory = 0
    for cage in _cages(Path(model)):
        surface = LimitSurface(cage, scheme)
        # Classes are found once for all tessellations.
        assert surface.patches.classes
        taken, before = [], peak_memory()
        for _ in range(3):
            start = time.process_time()
            table = surface.sampling(rate) if kind == "uniform" else surface.adaptive_sampling(_criterion(cage, error))
            table.apply(cage.positions)
            count = len(table.triangles)
            taken.append(time.process_time() - start)
            del table
        seconds += min(taken)
        triangles += count
        faces += cage.face_count
        memory += peak_memory() - before
    return {"faces": faces, "triangles": triangles, "seconds": seconds, "memory": memory}


def _distances(model, scheme, error):
    sys.path.append(str(Path(__file__).parents[1]))
    from tessellation.distances import distances

    largest = np.zeros(2)
    for cage in _cages(Path(model)):
        surface, criterion = LimitSurface(cage, scheme), _criterion(cage, error)
        away = distances(surface, surface.adaptive_sampling(criterion, MOST_SEGMENTS))
        largest = np.maximum(largest, np.divide(away, criterion.error))
    return dict(zip(("triangles", "surface"), largest.tolist(), strict=True))


def _cages(path):
    """Control cages of a file: one of a model, all limit surfaces of a stage, in the space of their points."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not path.suffix.startswith(".usd"):
            yield ControlCage.from_file(path)
            return
        from mitsuba_usd.stage_walk import StageReader

        reader = StageReader(path, None)
        contents = reader.at(None)
        shapes = [*contents.shapes, *(shape for group in contents.groups for shape in group)]
        for shape in shapes:
            if shape.cage.scheme is not None:
                yield ControlCage.from_arrays(**shape.cage.as_arguments())


if __name__ == "__main__":
    main()

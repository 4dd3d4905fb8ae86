"""Adaptive tessellations of models, against uniform ones in the same process.

python tests/benchmarks/adaptive.py MODEL.. [--schemes catmull_clark loop] [--errors 1 1e-3 outlines] [--rate 1]

For each model, scheme and error, in a process of its own: triangles, seconds of processor time, the least of three, and
the most memory that the process has taken beyond what it took before, once for a uniform tessellation and once for an
adaptive one whose triangles are no further from the surface than the error, in parts of the model's size. Both are
counted from prepared patches to points, normals and triangles; what uniform and adaptive have in common, as the classes
of patches, is made before. An error of 1 asks for the fewest triangles that the cage allows; "outlines" is what
pictures with exact shading ask for: outlines within a tenth of a pixel, where the model is 640 pixels large. A stage of
USD is tessellated mesh by mesh, and its rows are sums.
"""

import argparse
import json
import sys
import time
import warnings
from pathlib import Path

import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface
from mitsuba_subdivision.tessellation import Criterion, Measure, Sensor
from processes import measured, peak_memory

OUTLINES = "outlines"
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
                print(_row(model, scheme, error, options.rate), flush=True)


def _parsed(arguments):
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("models", nargs="*", type=Path, metavar="MODEL", help="OBJ, PLY or USD files")
    parser.add_argument("--schemes", nargs="+", default=["catmull_clark"])
    parser.add_argument("--errors", nargs="+", type=_error, default=[1.0, 1e-3, 1e-4, OUTLINES])
    parser.add_argument("--rate", type=int, default=1, help="of the uniform tessellation (default: 1)")
    parser.add_argument("--process", help=argparse.SUPPRESS)
    return parser.parse_args(arguments)


def _error(word):
    return word if word == OUTLINES else float(word)


def _row(model, scheme, error, rate):
    """One line of the table; each side is measured in a process of its own."""
    name = f"{model.name}, {scheme}, {error if error == OUTLINES else format(error, 'g')}"
    uniform, adaptive = (
        measured(name, [sys.executable, __file__, "--process", json.dumps([str(model), scheme, error, rate, kind])])
        for kind in ("uniform", "adaptive")
    )
    columns = "".join("{triangles:10,} {seconds:12.2f} {memory:5.0f}   ".format(**side) for side in (uniform, adaptive))
    beyond = adaptive["seconds"] - 2 * uniform["seconds"] if rate == 1 else adaptive["seconds"]
    return f"{name:27} {adaptive['faces']:6,} {columns}{1e6 * max(0, beyond) / adaptive['triangles']:8.2f}"


def _criterion(cage, error):
    size = np.linalg.norm(np.ptp(cage.positions, axis=0))
    if error != OUTLINES:
        return Criterion(Measure.CHORD, error * size)
    distance, pixels = 2.0, 640
    eye = cage.positions.mean(axis=0) + distance * size * np.array([0.6, 0.48, 0.64])
    sensor = Sensor(eye, 1 / (distance * pixels))
    return Criterion(Measure.CHORD, 0.1, sensor, sensor)


def _measured(model, scheme, error, rate, kind):
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

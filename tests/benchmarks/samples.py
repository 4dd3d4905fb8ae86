"""Time points, derivatives and normals at random places of a surface, with NumPy, against its tessellation.

python tests/benchmarks/samples.py [CAGE.obj ..] [--samples 20000] [--rate 4] [--repeats 15]

Both are times of the processor, for one sample and one vertex; the tessellation's are of a table that is made, applied
again to control points. Only the ratios within one run mean anything.
"""

import argparse
import time
from pathlib import Path

import mitsuba_subdivision as msub
import numpy as np

ROOT = Path(__file__).parents[2]


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("cages", nargs="*", type=Path, default=[ROOT / "scenes/cages/human.obj"])
    parser.add_argument("--samples", type=int, default=20000)
    parser.add_argument("--rate", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args(arguments)
    for path in options.cages:
        surface, rng = msub.LimitSurface(msub.ControlCage.from_file(path)), np.random.default_rng(0)
        classes = surface.patches.class_count
        places = [random_locations(surface, rng, options.samples) for _ in range(options.repeats)]
        first = seconds(surface.evaluate, *places[0])
        again = min(seconds(surface.evaluate, *where) for where in places)
        table = surface.sampling(options.rate)
        vertex_count = len(table.apply(surface.cage.positions)[0])
        vertices = min(seconds(table.apply, surface.cage.positions) for _ in places)
        sample, vertex = again / options.samples, vertices / vertex_count
        print(
            f"{path.stem}, {surface.patches.patch_count} patches, {classes} classes: first {1e3 * first:.0f} ms; again "
            f"{1e6 * sample:.2f} us a sample, {sample / vertex:.1f} times a vertex of the tessellation"
        )


def random_locations(surface, rng, count):
    """Element, parameters and corner."""
    elements, domain = surface.patches.elements, surface.scheme.domain
    element = rng.choice(np.flatnonzero(elements.face_sizes), count)
    uv = domain.from_square(rng.random((count, 2)))
    return element, uv, rng.integers(0, elements.face_sizes[element])


def seconds(work, *arguments):
    """Of the processor, that some work takes."""
    begin = time.process_time()
    work(*arguments)
    return time.process_time() - begin


if __name__ == "__main__":
    main()

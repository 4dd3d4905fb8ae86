"""Time points, derivatives and normals at random places of a surface, with NumPy, against its tessellation.

python tests/benchmarks/samples.py [CAGE.obj ..] [--samples 20000] [--rate 4] [--repeats 15]

Both are times of the processor, for one sample and one vertex; the tessellation's are of a table that is made, applied
again to control points. Only the ratios within one run mean anything.
"""

import argparse
from pathlib import Path

import mitsuba_subdivision as msub
import numpy as np
from processes import ROOT, Clock


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("cages", nargs="*", type=Path, default=[ROOT / "scenes/cages/human.obj"])
    parser.add_argument("--samples", type=int, default=20000)
    parser.add_argument("--rate", type=int, default=4)
    parser.add_argument("--repeats", type=int, default=15)
    options = parser.parse_args()
    for path in options.cages:
        surface, rng, clock = msub.LimitSurface(msub.ControlCage.from_file(path)), np.random.default_rng(0), Clock()
        classes, points = surface.patches.class_count, surface.cage.positions
        for _ in range(options.repeats):
            where = random_locations(surface, rng, options.samples)
            clock.lap()
            surface.evaluate(*where)
            clock.lap("samples")
        table = surface.sampling(options.rate)
        vertex_count = len(table.apply(points)[0])
        for _ in range(options.repeats):
            clock.lap()
            table.apply(points)
            clock.lap("vertices")
        first, *again = (processor for _, processor, _ in clock.laps["samples"])
        sample = min(again) / options.samples
        vertex = min(processor for _, processor, _ in clock.laps["vertices"]) / vertex_count
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


if __name__ == "__main__":
    main()

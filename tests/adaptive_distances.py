# ruff: noqa: T201
"""Distances of adaptive tessellations from the surface and back, in parts of the limit that was asked for.

python tests/adaptive_distances.py MODEL.. [--schemes catmull_clark loop] [--errors 1e-3 1e-4]

Both are measured as in `tessellation/distances.py`, and are to be one at most.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from mitsuba_subdivision import ControlCage, LimitSurface, SchemeError
from mitsuba_subdivision.tessellation import Criterion, Measure
from tessellation.distances import distances


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="+", type=Path, metavar="MODEL")
    parser.add_argument("--schemes", nargs="+", default=["catmull_clark"])
    parser.add_argument("--errors", nargs="+", type=float, default=[1e-3, 1e-4])
    parser.add_argument("--max-rate", type=int, default=1024)
    options = parser.parse_args()
    print("model, scheme, error                  triangles   triangles from surface   surface from triangles")
    for model in options.models:
        cage = ControlCage.from_file(model)
        size = np.linalg.norm(np.ptp(cage.positions, axis=0))
        for scheme in options.schemes:
            try:
                surface = LimitSurface(cage, scheme)
                for error in options.errors:
                    table = surface.adaptive_sampling(Criterion(Measure.CHORD, error * size), options.max_rate)
                    away, back = (each / (error * size) for each in distances(surface, table))
                    name = f"{model.stem}, {scheme}, {error:g}"
                    print(f"{name:38} {len(table.triangles):8} {away:24.3f} {back:24.3f}", flush=True)
            except SchemeError as reason:
                print(f"{model.stem}, {scheme}: {reason}", flush=True)


if __name__ == "__main__":
    main()

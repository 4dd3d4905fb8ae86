"""Print how accurate the evaluators are for each scheme and valence, and whether the project's bars hold.

    python tests/accuracy.py [--high]

The reference is explicit refinement in decimal arithmetic, down to u, v = 2^-45 and at the extraordinary point. Exits
with 1 if a bar does not hold. ``--high`` does valences 200 to 1000 instead, which takes minutes: there the samples
reach a few levels only, beside the limit point and normal by closed form.
"""

import argparse
import sys
import warnings

import numpy as np
from evaluation.common import BARS, largest_errors
from mitsuba_subdivision import LimitSurface
from reference import bars
from reference.exact_samples import SCHEMES, ExactSamples, angle, samples_at

VALENCES = (*range(3, 13), 20, 50, 100)
HIGH_VALENCES = (200, 500, 1000)
HIGH_LEVELS = (0, 2, 6)

# Column of the table, and the bar of the value there.
COLUMNS = {**BARS, "point f32": bars.POINT_FLOAT32, "normal f32": bars.NORMAL_FLOAT32}


def errors(exact: ExactSamples, surface: LimitSurface) -> dict[str, float]:
    """The largest error of each column over all samples; the point itself among them."""
    at_point = [[0.0, 0.0]]
    samples, limit = surface.evaluate(0, exact.uv, derivatives=2), surface.evaluate(0, at_point)
    single, single_limit = (surface.evaluate(0, uv, dtype=np.float32) for uv in (exact.uv, at_point))
    points, normals = {}, {}
    for suffix, here, there in (("", samples, limit), (" f32", single, single_limit)):
        at_samples, at_limit = np.abs(here.p - exact.p).max(), np.abs(there.p - exact.limit_p).max()
        points[f"point{suffix}"] = max(at_samples, at_limit) / exact.size
        normals[f"normal{suffix}"] = max(angle(here.n, exact.n).max(), angle(there.n[0], exact.limit_n))
    # At valence 2 the normal turns to and fro with the levels, and has no limit.
    return points if exact.valence == 2 else {**largest_errors(samples, exact), **points, **normals}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--high", action="store_true", help="valences 200, 500 and 1000 instead")
    high = parser.parse_args().high
    warnings.simplefilter("error")
    print(f"{'':20}" + "".join(f"{name:>12}" for name in COLUMNS))
    worst: dict[str, float] = {}
    for scheme in SCHEMES:
        for valence in HIGH_VALENCES if high else (*((2,) if scheme == "catmull_clark" else ()), *VALENCES):
            exact = samples_at(scheme, valence, HIGH_LEVELS) if high else samples_at(scheme, valence)
            surface = LimitSurface(exact.cage, scheme)
            row = errors(exact, surface)
            for name, error in row.items():
                if name != "normal f32" or valence <= bars.NORMAL_FLOAT32_VALENCES:
                    # A not-a-number, too, must count as a failure.
                    worst[name] = max(worst.get(name, 0.0), float(np.nan_to_num(error, nan=np.inf)))
            print(f"{scheme:14}{valence:6}" + "".join(_number(row.get(name)) for name in COLUMNS), flush=True)
    print(f"{'largest':20}" + "".join(_number(worst.get(name)) for name in COLUMNS))
    print(f"{'bar':20}" + "".join(map(_number, COLUMNS.values())))
    failed = [name for name, bar in COLUMNS.items() if name in worst and not worst[name] <= bar]
    held = [name for name in COLUMNS if name in worst and name not in failed]
    print(f"(above valence {bars.NORMAL_FLOAT32_VALENCES} normal f32 is not judged)")
    print(f"bars that hold: {', '.join(held) or 'none'}; bars that do not: {', '.join(failed) or 'none'}")
    return 1 if failed else 0


def _number(value: float | None) -> str:
    return f"{'-':>12}" if value is None else f"{value:12.1e}"


if __name__ == "__main__":
    sys.exit(main())

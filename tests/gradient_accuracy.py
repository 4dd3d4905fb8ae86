"""How exact gradients are: of pictures inside an outline, of outlines, and of integrals over triangles.

Inside: the derivative of a picture's mean by a motion of the control points that turns what is seen, beside central
differences of the picture with the same random numbers, under light from all sides. With interpolated normals and with
exact shading.

Outlines: the derivative of the area that a surface covers of a picture, by its size. Of a black shape before a white
sky, and of one that emits before nothing. The area itself is measured by scan lines, and the picture that emits
differentiated by differences.

Triangles: derivatives of area, volume, first and second moments of tessellations by motions of the control points,
beside those of the limit surface by quadrature, in parts of these.
"""

import argparse
import sys

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision

# isort: split
import mitsuba as mi
import numpy as np
from gradients import outlines, solids
from gradients.estimates import Estimate, Pictures
from gradients.scenes import POINTS, inside, textured_cube, tilt
from gradients.surfaces import CLOSED, motions
from mitsuba_subdivision.kernels.array_types import ArrayTypes
from shapes.cages import described

VARIANT = "llvm_ad_rgb"
MATERIALS, RATES = ("diffuse", "rough", "textured"), (2, 4, 8, 16)
STEP, GROWTH = 5e-3, 0.02
OUTLINE_RATES, INTEGRAL_RATES = (1, 2, 8), (4, 8, 16, 32)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    tables = {"inside": print_inside, "outlines": print_outlines, "triangles": print_triangles}
    parser.add_argument("--tables", nargs="+", default=list(tables), choices=tables)
    parser.add_argument("--spp", type=int, default=1024, help="samples per pixel and seed (default: 1024)")
    parser.add_argument("--seeds", type=int, default=6, help="renders that errors come from (default: 6)")
    options = parser.parse_args()
    mi.set_variant(VARIANT)
    for name in options.tables:
        tables[name](options.spp, options.seeds)


def off(estimate: Estimate, expected: float, random: float) -> str:
    """How far an estimate is off, and the standard error of that, in parts of the value."""
    return f"{(estimate.mean - expected) / abs(expected):+8.2%} +- {random / abs(expected):.2%}"


def print_inside(spp: int, seeds: int) -> None:
    print("material   shading  rate      gradient            difference            off")
    cage = textured_cube()
    for material in MATERIALS:
        for shading, rate in [*(("vertex", rate) for rate in RATES), ("exact", RATES[0])]:
            scene = inside(material, "around", described(cage, tessellation_rate=rate, shading=shading))
            pictures = Pictures(scene, {POINTS: tilt(cage.positions)}, spp, seeds)
            estimate, difference = pictures.reverse(), pictures.differences(STEP)
            apart = off(estimate, difference.mean, (estimate - difference).error)
            print(f"{material:<10} {shading:<8} {rate:4}  {estimate}  {difference}  {apart}", flush=True)


def print_outlines(spp: int, seeds: int) -> None:
    print("surface                 rate  area      black: off         emits, flat: off   emits: off", end="")
    print("          difference")
    for name, build in outlines.SURFACES.items():
        surface = build()
        positions = surface.cage.positions
        for rate in OUTLINE_RATES if name.startswith("concave") else [outlines.RATE]:
            expected = outlines.change(surface, positions, rate)
            estimates = []
            for emits, more in ((False, {}), (True, {"face_normals": True}), (True, {})):
                scene, along = outlines.outline_of(surface, rate, emits=emits, **more), {POINTS: positions}
                estimate = Pictures(scene, along, spp, seeds).reverse()
                estimates.append(estimate if emits else Estimate(-estimate.values))
            pictures = Pictures(scene, along, 4 * spp, seeds)
            texts = "   ".join(off(estimate, expected, estimate.error) for estimate in estimates)
            print(f"{name:<24} {rate:3}  {expected:.5f}  {texts}   {pictures.differences(GROWTH)}", flush=True)


def print_triangles(_spp: int, _seeds: int) -> None:
    print("surface         rate      area    volume     first    second")
    types = ArrayTypes(sys.modules["drjit.llvm.ad"].Float64)
    for name, build in CLOSED.items():
        surface = build()
        directions = list(motions(surface).values())
        exact = solids.exact_derivatives(surface, directions)
        for rate in INTEGRAL_RATES:
            _, of_triangles = solids.derivatives_of(surface, directions, rate, types)
            parts = zip(*(np.split(values, [1, 2, 5], axis=1) for values in (of_triangles - exact, exact)), strict=True)
            errors = (np.linalg.norm(error) / np.linalg.norm(value) for error, value in parts)
            print(f"{name:<14} {rate:5}  " + "  ".join(f"{error:8.1e}" for error in errors), flush=True)


if __name__ == "__main__":
    mitsuba_subdivision.register_variant(VARIANT)
    main()

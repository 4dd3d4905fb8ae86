"""How exact what a picture shows is: normals and mirror images of both kinds of shading, by tessellation rate.

Each cage is seen by one ray through the middle of each pixel. Its normals, and the radiance that a mirror would show
under a sky, are compared with exact shading of a tessellation of 64 segments per edge: where both rays hit, and hit
the same place of the surface to 3 % of the cage's size. Outlines depend on the triangles alone, and are left
out.
"""

import argparse

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision

# isort: split
import mitsuba as mi
import numpy as np
from kernels.surfaces import CAGES

CAMERAS = {
    "human": ([0, -12, 8], [0, 0, 4]),
    "rook": ([4, -6, 4], [0, 0, 1.2]),
    "star": ([3, -4, 2], [0, 0, 0]),
    "barrel": ([4, -6, 4], [0, 0, 0.5]),
}
REFERENCE_RATE, SAME_PLACE, BRIGHTEST = 64, 3e-2, 9


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cages", nargs="+", default=list(CAMERAS), choices=CAMERAS)
    parser.add_argument("--rates", nargs="+", type=int, default=[1, 2, 4, 8, 16])
    parser.add_argument("--resolution", type=int, default=512)
    parser.add_argument("--variant", default="llvm_ad_rgb")
    options = parser.parse_args()
    mi.set_variant(options.variant)
    mitsuba_subdivision.register_variant(options.variant)
    print("cage      rate  shading   normal: median      99 %   mirror image: median      99 %   elsewhere")
    for name in options.cages:
        reference = hits(name, REFERENCE_RATE, "exact", options.resolution)
        for rate in options.rates:
            for shading in ("vertex", "exact"):
                normal, radiance, elsewhere = differences(hits(name, rate, shading, options.resolution), reference)
                numbers = [np.quantile(errors, share) for errors in (normal, radiance) for share in (0.5, 0.99)]
                print(f"{name:<9} {rate:4}  {shading:<8}" + "          {:8.1e}  {:8.1e}".format(*numbers[:2]), end="")
                print("             {:8.1e}  {:8.1e}     {:7.2%}".format(*numbers[2:], elsewhere), flush=True)


def hits(name: str, rate: int, shading: str, resolution: int) -> dict[str, np.ndarray]:
    """What the rays hit: whether they do, points, normals and the rays' directions."""
    origin, target = CAMERAS[name]
    to_world = mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1])
    shape = {"type": "subdivision", "filename": str(CAGES / f"{name}.obj"), "tessellation_rate": rate}
    sensor = {"type": "perspective", "to_world": to_world, "fov": 30}
    scene = mi.load_dict({"type": "scene", "sensor": sensor, "shape": {**shape, "shading": shading}})
    y, x = (np.indices((resolution, resolution)).reshape(2, -1) + 0.5) / resolution
    ray, _ = scene.sensors()[0].sample_ray(0.0, 0.5, mi.Point2f(x, y), mi.Point2f(0.5))
    si, box = scene.ray_intersect(ray), scene.bbox()
    values = {"p": si.p, "n": si.sh_frame.n, "d": ray.d, "hit": si.is_valid(), "size": box.max - box.min}
    return {key: np.array(value).T for key, value in values.items()}


def differences(seen: dict[str, np.ndarray], reference: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Differences of normals and of mirrored radiance, where both rays hit the same place, and the share of others."""
    # On the surface or the triangle, both are on the ray.
    apart = np.linalg.norm(seen["p"] - reference["p"], axis=1)
    same = seen["hit"] & reference["hit"] & (apart < SAME_PLACE * np.abs(reference["size"]).max())
    one, other = (values["n"][same] for values in (seen, reference))
    radiance = [sky(mirrored(reference["d"][same], n)) for n in (one, other)]
    elsewhere = 1 - np.count_nonzero(same) / np.count_nonzero(seen["hit"] | reference["hit"])
    return np.linalg.norm(one - other, axis=1), np.abs(radiance[0] - radiance[1]), elsewhere


def mirrored(d: np.ndarray, n: np.ndarray) -> np.ndarray:
    return d - 2 * (d * n).sum(axis=1, keepdims=True) * n


def sky(d: np.ndarray) -> np.ndarray:
    """Smooth stripes of radiances from 0 to 9, ten around the horizon."""
    angle = np.arctan2(d[:, 1], d[:, 0])
    return BRIGHTEST / 2 * (1 + np.sin(10 * angle) * np.sqrt(np.maximum(1 - d[:, 2] ** 2, 0)))


if __name__ == "__main__":
    main()

# ruff: noqa: T201
"""How long uniform and adaptive tessellations take, from a cage in memory to a picture, with exact shading.

The human figure is seen as a whole, at equal errors of its outline (see tessellation_accuracy.py). Of the cage of
47,040 quadrilaterals, a camera looks at one vertex from near. What is printed is the last of three runs.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

# Before Mitsuba, so that Dr.Jit finds an LLVM library that works.
import mitsuba_subdivision

# isort: split
import drjit as dr
import mitsuba as mi
import numpy as np
from mitsuba_subdivision import ControlCage, pixel_error_for

ROOT = Path(__file__).resolve().parents[1]
RESOLUTION, RUNS = 512, 3
VIEW, NEAR, ASIDE = np.array([0.6, -1.1, 0.35]), 0.12, np.array([0.2, 0.1, 0.0])
UNIFORM = {"human": 16, "mixed": 8}
PIXEL_ERROR = {"human": 0.05, "mixed": 0.5}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cage", choices=UNIFORM)
    parser.add_argument("tessellation", choices=["uniform", "adaptive"])
    parser.add_argument("--spp", type=int, default=16, help="samples per pixel (default: 16)")
    options = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    mitsuba_subdivision.register_variant("llvm_ad_rgb")
    cage, sensor = staged(options.cage)
    how = {"tessellation_rate": UNIFORM[options.cage]}
    if options.tessellation == "adaptive":
        how = pixel_error_for(mi.load_dict(sensor), PIXEL_ERROR[options.cage], outline=True)
    shape = {"type": "subdivision", **cage.as_properties(mi), **how, "shading": "exact", "bsdf": {"type": "diffuse"}}
    for _ in range(RUNS):
        times = [time.perf_counter()]
        loaded = mi.load_dict(shape)
        dr.sync_thread()
        times.append(time.perf_counter())
        integrator = {"type": "path", "max_depth": 4}
        stage = {"type": "scene", "integrator": integrator, "sensor": sensor, "sky": {"type": "constant"}}
        scene = mi.load_dict({**stage, "shape": loaded})
        dr.sync_thread()
        times.append(time.perf_counter())
        dr.eval(mi.render(scene, spp=options.spp))
        dr.sync_thread()
        times.append(time.perf_counter())
        triangles = loaded.face_count()
        del loaded, scene
    load, hierarchy, picture = np.diff(times)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        f"{options.cage}, {options.tessellation}: {triangles} triangles, load {load:.3f} s, "
        f"hierarchy {hierarchy:.3f} s, picture {picture:.3f} s, all {load + hierarchy + picture:.3f} s, {memory:.0f} MB"
    )


def staged(name: str) -> tuple[ControlCage, dict]:
    """A cage, and the sensor that looks at it."""
    if name == "human":
        cage = ControlCage.from_file(ROOT / "scenes" / "cages" / "human.obj")
        low, high = cage.positions.min(axis=0), cage.positions.max(axis=0)
        target, up = (low + high) / 2, [0, 0, 1]
        origin = target + VIEW * np.linalg.norm(high - low)
    else:
        sys.path.insert(0, str(ROOT / "tests" / "benchmarks"))
        from cages import MAKERS

        points, quads = MAKERS["mix50k"]()
        cage = ControlCage(points, quads)
        target, up = points[points[:, 2].argmax()], [0, 1, 0]
        origin = target + NEAR * target / np.linalg.norm(target) + ASIDE
    to_world = mi.ScalarTransform4f().look_at(origin.tolist(), target.tolist(), up)
    film = {"type": "hdrfilm", "width": RESOLUTION, "height": RESOLUTION}
    return cage, {"type": "perspective", "fov": 40, "to_world": to_world, "film": film}


if __name__ == "__main__":
    main()

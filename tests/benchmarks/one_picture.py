"""One process of `first_picture.py`: it imports nothing before its clock starts but what reads that clock.

python tests/benchmarks/one_picture.py VARIANT KIND FILE RATE [MESH_TO_WRITE]
"""

import sys
import time


def main(variant, kind, path, rate, write=None):
    """Render a file with a shape of this kind, and print the seconds of each stage."""
    clock, processor = [time.perf_counter()], time.process_time()
    if kind == "subdivision":
        import mitsuba_subdivision  # noqa: F401 - registers the shape
    import mitsuba as mi
    import numpy as np

    clock.append(time.perf_counter())
    mi.set_variant(variant)
    clock.append(time.perf_counter())
    shape = {"type": kind, "filename": path}
    if kind == "subdivision":
        shape["tessellation_rate"] = int(rate)
    camera = mi.ScalarTransform4f().look_at(origin=[4, -6, 4], target=[0, 0, 0], up=[0, 0, 1])
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sky": {"type": "constant"},
        "sensor": {"type": "perspective", "to_world": camera, "film": {"type": "hdrfilm", "width": 128, "height": 128}},
        "surface": shape,
    }
    loaded = mi.load_dict(scene)
    clock.append(time.perf_counter())
    np.array(mi.render(loaded, spp=4))
    clock.append(time.perf_counter())
    processor = time.process_time() - processor

    import json

    if write:
        loaded.shapes()[0].write_ply(write)
    stages = dict(zip(("import", "variant", "load", "picture"), np.diff(clock).tolist(), strict=True))
    print(json.dumps(stages | {"total": clock[-1] - clock[0], "processor": processor}))


if __name__ == "__main__":
    main(*sys.argv[1:])

"""NumPy's arrays end where the memory does, in this process: `guarded_arrays.c` is built and used.

Kernels load whole packets, so that one that reads NumPy's memory reads beyond its end. Usually there is other memory,
and nothing happens. Here, the process ends. With the variable GUARDED_ARRAYS, all tests and notebooks import this
module. NumPy keeps the allocator in a variable of the context, which threads do not inherit: they have its own.
"""

import importlib.util
import os
import subprocess
import sysconfig
import tempfile
from pathlib import Path

import numpy as np

SOURCE = Path(__file__).with_suffix(".c")


def _built(folder: str) -> str:
    target = os.path.join(folder, "_guarded_arrays" + sysconfig.get_config_var("EXT_SUFFIX"))
    includes = [f"-I{sysconfig.get_paths()['include']}", f"-I{np.get_include()}"]
    compiler = os.environ.get("CC", "cc")
    subprocess.run([compiler, "-O1", "-shared", "-fPIC", *includes, str(SOURCE), "-o", target], check=True)
    return target


with tempfile.TemporaryDirectory() as folder:
    # The library stays mapped after its file is gone.
    specification = importlib.util.spec_from_file_location("_guarded_arrays", _built(folder))
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
module.begin()

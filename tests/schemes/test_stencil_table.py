"""Refinement and evaluation need no more than NumPy where there is little to do."""

import subprocess
import sys


def test_a_cage_of_few_classes_is_tessellated_without_scipy():
    """Its import costs more time and memory than a small cage."""
    program = (
        "import sys, mitsuba_subdivision as msub\n"
        "for scheme in ('catmull_clark', 'loop', 'doo_sabin'):\n"
        "    cage = msub.ControlCage([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)],\n"
        "                            [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)])\n"
        "    msub.LimitSurface(cage, scheme).tessellate(4)\n"
        "sys.exit(any(name.startswith('scipy') for name in sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")

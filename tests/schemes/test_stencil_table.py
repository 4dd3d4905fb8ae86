"""Stencil tables: the two ways to look at one agree, and loading needs no more than NumPy."""

import subprocess
import sys

import numpy as np
from mitsuba_subdivision.schemes import StencilTable
from scipy import sparse

# Sums of a few weights near one.
ROUNDING = 1e-15


def scattered(row_count, column_count, count, seed):
    random = np.random.default_rng(seed)
    rows, columns = random.integers(row_count, size=count), random.integers(column_count, size=count)
    return rows, columns, random.standard_normal(count)


def test_entries_of_rows_are_those_of_the_matrix():
    """Rows without entries, asked for twice and in any order; entries at equal places."""
    rows, columns, weights = scattered(7, 5, 60, seed=1)
    keep = rows != 3
    table = StencilTable.of(7, 5, (rows[keep], columns[keep], weights[keep]), (np.array([0, 6]), np.array([4, 4]), 0.5))
    wanted = np.array([6, 3, 0, 6, 2])
    expected, dense = np.zeros((7, 5)), np.zeros((5, 5))
    np.add.at(expected, (table.rows, table.columns), table.weights)
    rows, columns, weights = table.entries(wanted)
    np.add.at(dense, (rows, columns), weights)
    np.testing.assert_allclose(dense, expected[wanted], rtol=0, atol=20 * ROUNDING)
    assert (np.diff(rows) >= 0).all()
    np.testing.assert_allclose(table.matrix.toarray(), expected, rtol=0, atol=20 * ROUNDING)


def test_table_of_a_sparse_array_gives_it_back():
    rows, columns, weights = scattered(9, 4, 20, seed=2)
    matrix = sparse.coo_array((weights, (rows, columns)), shape=(9, 4)).tocsr()
    table = StencilTable.from_matrix(matrix)
    np.testing.assert_array_equal(table.matrix.toarray(), matrix.toarray())


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

import numpy as np
from mitsuba_subdivision.cage.source import CageSource


def test_arrays_are_numbered_from_zero_and_long_lists_of_faces_are_cut():
    source = CageSource()
    assert source.at_face(4) == "control cage: face 4"
    assert source.at_vertex(0) == "control cage: vertex 0"
    assert source.edge(3, 7) == "edge (3, 7)"
    assert source.faces(np.array([2])) == "face 2"
    assert source.faces(np.arange(10)) == "faces 0, 1, 2, 3, 4, 5 and 4 more"


def test_files_name_the_line_and_their_own_numbers():
    source = CageSource('"cube.obj"', 1, np.array([2, 3]), np.array([5, 17]))
    assert source.at_face(1) == '"cube.obj", line 17: face 2'
    assert source.at_vertex(0) == '"cube.obj", line 2: vertex 1'
    assert source.edge(0, 1) == "edge (1, 2)"
    assert source.faces(np.array([0, 1])) == "faces 1 (line 5), 2 (line 17)"

"""Readers and writers of files: OBJ, PLY and USD.

A new format is one module with its functions, and one line in this table.
"""

from ..cage.formats import Format

_USD = Format("usd_reader:read_usd", "usd_writer:write_usd", "usd_writer:write_usd_triangles", has_prims=True)
# Formats by suffix.
FORMATS = {
    ".obj": Format("obj_reader:read_obj", "obj_writer:write_obj", "obj_writer:write_obj_triangles"),
    ".ply": Format("ply_reader:read_ply", "ply_writer:write_ply", "ply_writer:write_ply_triangles"),
    ".usd": _USD,
    ".usda": _USD,
    ".usdc": _USD,
    # An archive of finished USD files, which can be read but not written.
    ".usdz": Format(_USD.read, has_prims=True),
}

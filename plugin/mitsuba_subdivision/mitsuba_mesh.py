"""Triangles in memory as a mesh of Mitsuba."""

from __future__ import annotations

from collections.abc import Mapping

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .device_arrays import upload

# Buffers that a mesh has without adding them as attributes.
OWN_BUFFERS = ("vertex_positions", "vertex_normals", "vertex_texcoords")


def mitsuba_mesh(
    name: str,
    triangles: NDArray[np.integer],  # (m, 3)
    # (n, k) each: `vertex_positions`, and if the mesh has them `vertex_normals`, `vertex_texcoords`, and attributes of
    # vertices or faces, `vertex_NAME` or `face_NAME`
    buffers: Mapping[str, NDArray],
    *,
    bsdf: mi.BSDF | None = None,
    emitter: mi.Emitter | None = None,
    interior: mi.Medium | None = None,
    # Whether vertices get the averages of the normals of their triangles. Without normals, triangles are flat.
    averages_normals: bool = False,
) -> mi.Mesh:
    """Make a mesh of the current variant."""
    properties = mi.Properties()
    for key, part in (("bsdf", bsdf), ("emitter", emitter), ("interior", interior)):
        if part is not None:
            properties[key] = part
    mesh = mi.Mesh(
        name,
        len(buffers["vertex_positions"]),
        len(triangles),
        props=properties,
        has_vertex_normals=averages_normals or "vertex_normals" in buffers,
        has_vertex_texcoords="vertex_texcoords" in buffers,
    )
    for key, values in buffers.items():
        if key not in OWN_BUFFERS:
            mesh.add_attribute(key, values.shape[1], [0.0] * values.size)
    parameters = mi.traverse(mesh)
    for key, values in {"faces": triangles, **buffers}.items():
        stored = values
        if mi.is_spectral and key not in OWN_BUFFERS and values.shape[1] == 3 and "color" in key.lower():
            # Of colours, Mitsuba's meshes store spectra.
            colors, row = np.unique(values, axis=0, return_inverse=True)
            stored = np.array([mi.srgb_model_fetch(color) for color in colors.tolist()])[row.ravel()]
        parameters[key] = upload(type(parameters[key]), stored)
    parameters.update()
    if averages_normals:
        mesh.recompute_vertex_normals()
    return mesh

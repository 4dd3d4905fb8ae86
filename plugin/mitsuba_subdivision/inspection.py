"""Elements of a control cage, the cost of its surface, and its visible defects."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from .cage import RULES, ControlCage, attributes_by_name
from .mesh.connectivity import IntArray, Topology, VertexRule
from .mesh.cuts import seams
from .surface import LimitSurface

# Classes of patches above which their weights dominate the time; semi-sharp ones count once for each refinement.
MANY_CLASSES = 1000
HIGH_VALENCE = 12  # Higher valences are visible in renders as a pinch
# Bytes in single precision: position and normal of a vertex; texture coordinates; vertices and element of a triangle.
VERTEX_BYTES, TEXCOORD_BYTES, TRIANGLE_BYTES = 24, 8, 16


def inspect(surface: LimitSurface, rate: int = 8) -> dict[str, Any]:
    """Describe a surface, and its tessellation with ``rate`` segments per edge, by plain values."""
    if rate < 1:
        raise ValueError(f"tessellation rate {rate}; expected 1 or more segments per edge")
    cage, t = surface.cage, surface.cage.topology
    used = cage.positions[t.face_vertices]
    rules = {name: getattr(cage, name) for name in RULES}
    triangle_count, vertex_count = _tessellation_size(surface, rate)
    vertex_bytes = VERTEX_BYTES + (TEXCOORD_BYTES if cage.texcoords else 0)
    return {
        "name": cage.source.name,
        "scheme": surface.scheme.name,
        "vertex_count": cage.vertex_count,
        "edge_count": len(cage.edges),
        "face_count": cage.face_count,
        "component_count": _piece_count(t, np.arange(t.half_edge_count)),
        "bounding_box": (used.min(axis=0).tolist(), used.max(axis=0).tolist()),
        "face_sizes": _histogram(cage.face_sizes),
        "valences": _histogram(t.vertex_face_count[_inner_vertices(cage)]),
        "boundary_edge_count": int(cage.is_boundary.sum()),
        "boundary_loop_count": _piece_count(t, np.flatnonzero(cage.is_boundary)),
        "boundary": cage.boundary,
        "rules": {name: rule for name, rule in rules.items() if name != "boundary" and rule != RULES[name][0]},
        "sharp": _sharp_features(cage),
        "attributes": _attributes(cage),
        "patch_count": surface.patches.patch_count,
        "class_count": len(surface.patches.classes),
        "rate": rate,
        "triangle_count": triangle_count,
        "mesh_bytes": vertex_count * vertex_bytes + triangle_count * TRIANGLE_BYTES,
        "warnings": list(_warnings(surface)),
    }


def in_words(inspected: dict[str, Any]) -> str:
    """Lines of text for the values of `inspect`."""
    of = SimpleNamespace(**inspected)
    loops = f"{of.boundary_loop_count:,} loop{'s' * (of.boundary_loop_count != 1)}, rule {of.boundary}"
    boundary = f"{of.boundary_edge_count:,} edges in {loops}"
    rows = [
        ("cage", f"{of.name}: {of.vertex_count:,} vertices, {of.edge_count:,} edges, {of.face_count:,} faces"),
        ("pieces", f"{of.component_count:,} that share no vertex" if of.component_count > 1 else ""),
        ("box", " to ".join("({:g}, {:g}, {:g})".format(*corner) for corner in of.bounding_box)),
        ("faces", _listed(of.face_sizes, "{:,} of {} corners")),
        ("inner vertices", _listed(of.valences, "{:,} of valence {}")),
        ("boundary", boundary if of.boundary_edge_count else "none, the cage is closed"),
        ("sharp", ", ".join(f"{count:,} {what}" for what, count in of.sharp.items() if count) or "nothing"),
        ("rules", ", ".join(f"{name} {rule}" for name, rule in of.rules.items()) or "the default"),
        ("attributes", ", ".join(f"{name}: {what}" for name, what in of.attributes.items()) or "none"),
        ("patches", f"{of.patch_count:,} of {of.class_count:,} classes under {of.scheme}"),
        ("at rate", f"{of.rate}: {of.triangle_count:,} triangles, {of.mesh_bytes / 1e6:,.1f} MB as a mesh"),
        *(("warning", warning) for warning in of.warnings),
    ]
    return "\n".join(f"{title + ':':<16}{text}" for title, text in rows if text)


def _inner_vertices(cage: ControlCage) -> NDArray[np.bool_]:
    """``(n_v,)`` whether faces surround each vertex exactly once."""
    t = cage.topology
    inner = ~t.is_border_vertex & (t.vertex_face_count > 0)
    return inner if cage.non_manifold is None else inner & ~cage.non_manifold.is_vertex


def _histogram(values: IntArray) -> dict[int, int]:
    return dict(sorted(Counter(values.tolist()).items()))


def _listed(counts: dict[int, int], form: str, shown: int = 8) -> str:
    commonest = Counter(counts).most_common()
    parts = [form.format(count, value) for value, count in commonest[:shown]]
    if others := commonest[shown:]:
        parts.append(f"{len(others)} other kinds up to {max(others)[0]}")
    return ", ".join(parts) or "none"


def _piece_count(t: Topology, half_edges: IntArray) -> int:
    ends = t.face_vertices[half_edges], t.face_vertices[t.next[half_edges]]
    graph = sparse.coo_array((np.ones(len(half_edges), dtype=bool), ends), shape=(t.vertex_count, t.vertex_count))
    return len(np.unique(connected_components(graph, directed=False)[1][ends[0]]))


def _sharp_features(cage: ControlCage) -> dict[str, int]:
    t, tags, non_manifold = cage.topology, cage.tags, cage.non_manifold
    edges = tags.edges[t.edge_half_edge]
    if non_manifold is not None:
        edges = edges[~non_manifold.is_edge[t.edge_half_edge]]
    return {
        "infinitely sharp edges": int((edges >= 10).sum()),
        "semi-sharp edges": int(((edges > 0) & (edges < 10)).sum()),
        "corners": int(tags.is_corner.sum()),
        "semi-sharp vertices": int(((tags.vertices > 0) & ~tags.is_corner).sum()),
        "darts": int((cage.cut_mesh.topology.vertex_rules == VertexRule.DART).sum()),
        "holes": len(cage.holes),
        "non-manifold edges": 0 if non_manifold is None else len(np.unique(non_manifold.edge[non_manifold.is_edge])),
        "non-manifold vertices": 0 if non_manifold is None else int(non_manifold.is_vertex.sum()),
    }


def _attributes(cage: ControlCage) -> dict[str, str]:
    t, described = cage.topology, {}
    for name, attribute in attributes_by_name(cage.texcoords, cage.attributes).items():
        described[name] = attribute.interpolation.replace("_", "-")
        if attribute.indices is not None:
            count = np.count_nonzero(seams(t, attribute.indices)[t.edge_half_edge])
            described[name] += f" with {count:,} seam edges, rule {cage.face_varying}"
    return described


def _tessellation_size(surface: LimitSurface, rate: int) -> tuple[int, int]:
    sizes = surface.patches.elements.face_sizes
    if surface.scheme.domain.corner_count == 3:
        triangles = len(sizes) * rate**2
    else:
        # Each corner of a polygon has a quarter of a square; with an odd rate, one more triangle closes the middle.
        triangles = np.where(sizes == 4, 2 * rate**2, sizes * (rate**2 + rate % 2) // 2).sum()
    # Euler's formula for a sphere; handles and borders change it very little.
    return int(triangles), int(triangles) // 2 + 2


def _warnings(surface: LimitSurface) -> Iterator[str]:
    cage, scheme, t = surface.cage, surface.scheme, surface.cage.topology
    inner = _inner_vertices(cage)
    if unused := np.count_nonzero(t.vertex_face_count == 0):
        yield f"{unused:,} vertices belong to no face"
    triangles = np.count_nonzero(cage.face_sizes == 3)
    if scheme.name == "catmull_clark" and triangles > cage.face_count / 2:
        ripples = f"{triangles:,} of {cage.face_count:,} faces are triangles, on which Catmull-Clark ripples"
        yield f'{ripples}; Loop is made for them, and triangle_rule "smooth" helps'
    if low := np.count_nonzero(inner & (t.vertex_face_count == 2)):
        yield f"{low:,} inner vertices have valence 2, whose normals the surface does not approach smoothly"
    if (high := int(t.vertex_face_count[inner].max(initial=0))) > HIGH_VALENCE:
        yield f"the highest valence is {high}: the surface is pinched around it"
    if scheme.element == "face":
        cut = cage.cut_mesh.topology
        border = cut.is_border_vertex & (cut.vertex_rules == VertexRule.AUTOMATIC)
        # Schemes without rules at borders have no such number, and accept no cages with borders.
        limit = scheme.regular_border_faces if border.any() else 0
        if crowded := np.count_nonzero(border & (cut.vertex_face_count >= 2 * limit)):
            where = f"{crowded:,} vertices on borders or creases"
            yield f"{where} have {2 * limit} or more faces on one side: there is no tangent plane there"
    edges = cage.positions[t.face_vertices] == cage.positions[t.face_vertices[t.next]]
    if collapsed := np.count_nonzero(edges.all(axis=1)):
        yield f"{collapsed:,} edges of faces have no length: points coincide there, and the normal may be undefined"
    classes = surface.patches.classes
    sharpest = max(patch_class.signature.sharpness for patch_class in classes)
    if sum(1 + np.ceil(patch_class.signature.sharpness) for patch_class in classes) > MANY_CLASSES:
        semi_sharp = f", semi-sharp up to {sharpest:g}" if sharpest else ""
        many = f"{len(classes):,} classes of patches{semi_sharp}"
        yield f"{many}: preparing them takes longer than evaluating the surface"

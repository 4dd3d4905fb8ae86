"""Scheme of a cage with the rules of the cage, for its points and for its attributes."""

from __future__ import annotations

import numpy as np

from ..cage import Attribute, ControlCage, shortened, warn
from ..mesh.connectivity import IntArray, Topology
from ..mesh.cuts import seams, value_mesh
from ..schemes import Scheme, SchemeError, scheme_named, with_rules
from ..schemes.scheme import require_scheme


def adapted_scheme(cage: ControlCage, chosen: str | Scheme | None) -> Scheme:
    """Return a scheme with the cage's rules: ``chosen``, by default the cage's scheme, else Catmull-Clark.

    Raises SchemeError if the scheme is unknown, does not support a face, a vertex or a tag of the cage, or if the cage
    has no surface. Warns if the cage's file names another scheme.
    """
    scheme = _with_rules_of(cage, chosen)
    cut, source = cage.cut_mesh, cage.source
    if scheme.element == "vertex" and cut.topology.is_border_vertex.all():
        raise SchemeError(f"{source.name}: the scheme {scheme.name} makes no surface of a cage without inner vertices")
    if scheme.element == "face" and cage.is_hole.all():
        raise SchemeError(f'{source.name}: boundary "none" leaves no face, as all are holes or touch the boundary')
    if (unsupported := scheme.unsupported(cut.topology)) is not None:
        first = int(unsupported.indices[0])
        where = source.at_face(first) if unsupported.kind == "face" else source.at_vertex(int(cut.vertex[first]))
        expected = f"the scheme {scheme.name} expects {unsupported.expected}"
        count = f"{len(unsupported.indices)} in all; numbers count from {source.index_base}"
        raise SchemeError(f"{where} {unsupported.problem}; {expected} ({count})")
    return scheme


def _with_rules_of(cage: ControlCage, chosen: str | Scheme | None) -> Scheme:
    chosen = chosen or cage.scheme or "catmull_clark"
    scheme = scheme_named(chosen) if isinstance(chosen, str) else chosen
    require_scheme(scheme)
    if cage.scheme not in (None, scheme.name):
        warn(f'{cage.source.name}: asks for the scheme "{cage.scheme}"; "{scheme.name}" is used')
    cut = cage.cut_mesh.topology
    semi_sharp = cut.semi_sharpness is not None
    lacking = {
        "creases and corners": scheme.element == "vertex" and cage.tags.any,
        "semi-sharp creases and corners": semi_sharp and scheme.crease_method is None,
        "holes": scheme.element == "vertex" and len(cage.holes) > 0,
        "borders, nor for infinitely sharp creases and corners, as it states no phantom_points; expected a closed "
        "cage without such features": scheme.element == "face"
        and not scheme.has_phantom_points
        and bool((cut.twin < 0).any() or cut.vertex_rules.any()),
    }
    for feature, is_lacking in lacking.items():
        if is_lacking:
            raise SchemeError(f"{cage.source.name}: the scheme {scheme.name} has no rules for {feature}")
    has_triangles = scheme.domain.corner_count == 4 and (cage.face_sizes == 3).any()
    triangle_rule = cage.triangle_rule if has_triangles else "catmull_clark"
    try:
        return with_rules(scheme, cage.crease_method if semi_sharp else "uniform", triangle_rule)
    except SchemeError as error:
        raise SchemeError(f"{cage.source.name}: {error}") from None


def subdivided_values(cage: ControlCage, scheme: Scheme, name: str, attribute: Attribute) -> tuple[Topology, IntArray]:
    """Return the mesh on which an attribute's values at corners are subdivided, and the row of each vertex's value.

    Raises SchemeError if the scheme has no rules for the attribute.
    """
    # Varying attributes have one value per vertex instead of indices.
    indices = cage.topology.face_vertices if attribute.indices is None else attribute.indices
    label = f"{cage.source.name}: the scheme {scheme.name} has no rules for"
    of_attribute = f'as of the attribute "{shortened(name)}"'
    if scheme.element == "face":
        topology, value_index = value_mesh(cage.structure, cage.face_varying, indices)
        if not scheme.has_phantom_points and ((topology.twin < 0).any() or topology.vertex_rules.any()):
            expected = 'expected an attribute without seams, or face_varying "all"'
            raise SchemeError(f"{label} seams, {of_attribute}, as it states no phantom_points; {expected}")
        return topology, value_index
    has_seams = seams(cage.topology, indices).any()
    if has_seams or attribute.interpolation == "varying" or cage.face_varying == "all":
        lacking = "seams" if has_seams else "linear interpolation"
        expected = "one that is subdivided as points are, without seams"
        raise SchemeError(f"{label} {lacking}, {of_attribute}; expected {expected}")
    topology = cage.cut_mesh.topology
    value_index = np.zeros(topology.vertex_count, dtype=np.int64)
    value_index[topology.face_vertices] = indices
    return topology, value_index

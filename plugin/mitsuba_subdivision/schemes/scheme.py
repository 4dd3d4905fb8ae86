"""What a subdivision scheme states: refinement rules, regular basis and parameter domain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.sharpness import CreaseMethod, SemiSharpness
from ..mesh.signature import ElementKind
from .domain import AffineMap, FloatArray, ParameterDomain
from .stencil_table import StencilTable


class SchemeError(ValueError):
    """A scheme cannot be used: unknown name, or an element that its rules do not cover."""


def described(scheme: Scheme) -> str:
    """A scheme's class, and those of its rules that are not the usual ones."""
    rules = [f'{name}="{vars(scheme)[name]}"' for name in ("crease_method", "triangle_rule") if name in vars(scheme)]
    return f"{type(scheme).__name__}({', '.join(rules)})"


@dataclass(frozen=True, eq=False)
class Refinement:
    """One application of a scheme's rules.

    Attributes
    ----------
    topology : Topology
        The refined mesh.
    stencils : StencilTable
        Of the refined vertices over the vertices before.
    """

    topology: Topology
    stencils: StencilTable

    def apply(self, points: FloatArray) -> FloatArray:
        """Refined points, ``(n_new, k)``, from those before."""
        return self.stencils.matrix @ points


@dataclass(frozen=True)
class BorderRule:
    """A control point beyond the border as a combination of others, which continues the border's rules inwards.

    Attributes
    ----------
    offsets : tuple of (2,)
        Lattice steps from the point beyond to others.
    weights : tuple of float
        Of these, in the same order.
    """

    offsets: tuple[tuple[float, float], ...]
    weights: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class Unsupported:
    """Faces or vertices that a scheme has no rules for.

    Attributes
    ----------
    kind : "face" or "vertex"
    indices : (n,) int64
        0-based, at least one.
    problem : str
        What is wrong with the first, such as "has 5 corners".
    expected : str
    """

    kind: Literal["face", "vertex"]
    indices: IntArray
    problem: str
    expected: str


@runtime_checkable
class Scheme(Protocol):
    """A stationary subdivision scheme. Everything else is derived by running `refine` on local meshes.

    `register_scheme` checks all of this, as far as it can be seen on the one-rings of vertices of few faces. Objects of
    a scheme are keys, by which what is derived from them is kept, and must not change.

    Attributes
    ----------
    name : str
    element : "face" or "vertex"
        What a parameter domain belongs to.
    domain : ParameterDomain
        `SQUARE` or `TRIANGLE`, with as many corners as a regular face, or as a regular vertex has faces.
    regular_face_size, regular_valence : int
        A one-ring of such faces and vertices only has a polynomial limit surface.
    regular_lattice : (R, 2) float64
        Parameters at which the control points of the regular patch sit.
    first_edge : (2, 2) float64
        Lattice points at the two ends of the half-edge that names the regular element.
    edge_turn : (2, 2) float64
        Turns a lattice edge of a regular face into the edge that follows it.

    Notes
    -----
    A scheme may have these as well:

    border_rules : tuple of BorderRule, or None
        How a regular patch's control points beyond the border follow from those within; empty if none lie there. None,
        the default, means that the scheme has no rules at borders: where its elements are faces, open cages and
        infinitely sharp creases and corners are refused.
    regular_border_faces : int
        Number of regular faces at a vertex on the border, beside which the limit surface is still polynomial; at a
        corner it is one. Needed with border rules.
    splits_corners : bool
        Whether refined face ``h`` is the quadrilateral at the corner ``h`` of the mesh before, and begins there. Then
        cages with many classes of patches are refined once, which saves time. False by default.
    crease_method : "uniform" or "chaikin"
        How semi-sharp features decay, in `refine`; a copy of the scheme gets the value that a cage asks for. By default
        semi-sharp features are refused.
    triangle_rule : "catmull_clark" or "smooth"
        How triangles are refined, likewise. By default cages that ask for "smooth" are refused.
    """

    name: str
    element: ElementKind
    domain: ParameterDomain
    regular_face_size: int
    regular_valence: int
    regular_lattice: FloatArray
    first_edge: FloatArray
    edge_turn: FloatArray

    def unsupported(self, topology: Topology) -> Unsupported | None:
        """Say what the rules do not cover in a mesh, if anything."""
        ...

    def refine(self, topology: Topology) -> Refinement:
        """Apply the rules once to a whole mesh of supported faces and vertices; for stencils see `StencilTable.of`.

        Refined faces and vertices must have the same numbers whatever is semi-sharp. Stencils may depend on where that
        is, and on how sharp what this refinement makes smooth; not on how much it leaves of the rest. It saves time if
        refined faces of a mesh of unconnected parts come in the order in which they do in each part alone.
        """
        ...

    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[AffineMap, int]]:
        """Parts of the element named by a half-edge after one refinement.

        Each is a map from the element's parameters to the part's own, and the half-edge of the refined mesh that names
        the part. Usually the four copies of the domain; one part, with the identity, where the rules first have to
        make the element regular (an n-gon's corner under Catmull-Clark).
        """
        ...

    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Weights of the regular patch's control points, in the order of `regular_lattice`.

        Parameters
        ----------
        uv : (s, 2) float
            The precision of ``uv`` is the precision of the result.
        derivatives : 0, 1 or 2

        Returns
        -------
        (1, s, R), (3, s, R) or (6, s, R)
            Value; d/du, d/dv; d2/du2, d2/dudv, d2/dv2.
        """
        ...


def kept_rules(topology: Topology, new_count: int) -> NDArray[np.int8] | None:
    """Vertex rules after a refinement that keeps the vertices and appends new ones."""
    if topology.rules is None:
        return None
    return np.concatenate([topology.rules, np.zeros(new_count, dtype=np.int8)])


def kept_sharpness(
    topology: Topology, face_vertices: NDArray[np.integer], last: int, new_count: int, method: CreaseMethod
) -> SemiSharpness | None:
    """Semi-sharp features after a refinement that keeps the vertices and makes a face at every corner of the old mesh.

    Parameters
    ----------
    face_vertices : (n_h',) int
        Of the refined mesh: the corners' faces, listed from the old vertex on, come first.
    last : int
        The last edge of a corner's face; it and the first one are halves of the old edges at the vertex.
    new_count : int
        Vertices that are new.
    method : "uniform" or "chaikin"
    """
    semi, t = topology.semi_sharpness, topology
    if semi is None:
        return None
    edges = np.zeros(len(face_vertices))
    corners = edges[: t.half_edge_count * (last + 1)].reshape(t.half_edge_count, last + 1)
    corners[:, 0] = semi.edges_left
    ahead = t.turn(np.arange(t.half_edge_count))
    corners[:, last] = np.where(ahead < 0, 0, semi.edges_left[ahead])
    return semi.refined(face_vertices, edges, new_count, method)


def low_valence(topology: Topology, least: int) -> Unsupported | None:
    """Interior vertices of a valence below the least that a scheme supports."""
    inside = ~topology.is_boundary_vertex & (topology.vertex_face_count > 0)
    low = np.flatnonzero(inside & (topology.vertex_face_count < least))
    if not len(low):
        return None
    return Unsupported("vertex", low, f"has valence {topology.vertex_face_count[low[0]]}", f"valence {least} or more")


def tensor_basis(u: FloatArray, v: FloatArray, derivatives: int) -> FloatArray:
    """Products of one-dimensional bases.

    Parameters
    ----------
    u, v : (derivatives + 1, s, r)
        Values and derivatives of the one-dimensional basis along each direction.

    Returns
    -------
    (1 | 3 | 6, s, r * r), u fastest, in the order of `Scheme.regular_basis`.
    """
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)][: (derivatives + 1) * (derivatives + 2) // 2]
    products = np.stack([v[b][:, :, None] * u[a][:, None, :] for a, b in orders])
    return products.reshape(len(orders), u.shape[1], u.shape[2] * v.shape[2])

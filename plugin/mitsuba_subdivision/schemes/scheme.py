"""The base class of a subdivision scheme, and what the rules of several schemes share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh.connectivity import IntArray, Topology
from ..mesh.sharpness import CreaseMethod, SemiSharpness
from ..mesh.signature import ElementKind
from .domain import AffineMap, FloatArray, ParameterDomain
from .stencil_table import StencilTable

# How Catmull-Clark refines triangles.
TriangleRule = Literal["catmull_clark", "smooth"]


class SchemeError(ValueError):
    """A scheme cannot be used: its name is unknown, it is no scheme, or its rules do not cover a cage."""


class Refinement(NamedTuple):
    """One application of a scheme's rules.

    Attributes
    ----------
    topology : Topology
        The refined mesh.
    stencils : StencilTable
        The refined vertices as weighted sums of the vertices before.
    """

    topology: Topology
    stencils: StencilTable

    def apply(self, points: FloatArray) -> FloatArray:
        """Refined points, ``(n_new, k)``, from those before."""
        return self.stencils.matrix @ points


class PhantomPoint(NamedTuple):
    """A phantom point: a control point beyond the border as a combination of control points within.

    With these points a patch beside the border is a regular one, whose limit surface is that of the masks at borders.

    Attributes
    ----------
    offsets : tuple of (2,)
        Lattice steps from the phantom point to the control points that it is made of.
    weights : tuple of float
        Their weights, in the same order; they sum to one.
    """

    offsets: tuple[tuple[float, float], ...]
    weights: tuple[float, ...]


class Unsupported(NamedTuple):
    """Faces or vertices that a scheme has no rules for.

    Attributes
    ----------
    kind : "face" or "vertex"
    indices : (n,) int64
        0-based numbers of these faces or vertices, at least one.
    problem : str
        The problem of the first of them, such as "has 5 corners".
    expected : str
        Meshes that the scheme has rules for, such as "triangles only".
    """

    kind: Literal["face", "vertex"]
    indices: IntArray
    problem: str
    expected: str


class Scheme(ABC):
    """Base class of every stationary subdivision scheme: refinement rules, regular basis and parameter domain.

    Everything else is derived by running `refine` on local meshes. Scheme objects are keys of caches of derived data,
    so they must have a hash and never change; a copy gets the ``crease_method`` and the ``triangle_rule`` of a cage.
    `check_scheme` tries the rules of a scheme.

    Attributes
    ----------
    name : str
    element : "face" or "vertex"
        The elements, with a parameter domain each: faces of the cage, or vertices.
    domain : ParameterDomain
        `SQUARE` or `TRIANGLE`, with as many corners as a regular face, or as a regular vertex has faces.
    regular_face_size, regular_valence : int
        A one-ring of such faces and vertices only has a polynomial limit surface.
    regular_lattice : (R, 2) float64
        Parameters at which the control points of the regular patch sit.
    first_edge : (2, 2) float64
        Lattice points at the two ends of the half-edge that names the regular element.
    edge_turn : (2, 2) float64
        Matrix that turns a lattice edge of a regular face into the edge that follows it.
    phantom_points : tuple of PhantomPoint, or None
        How a regular patch's control points beyond the border follow from those within; empty if none lie there. With
        None, the default, a scheme whose elements are faces refuses open cages and infinitely sharp creases and
        corners.
    regular_border_faces : int
        Number of regular faces at a vertex on the border, beside which the limit surface is still polynomial; at a
        corner it is one. A scheme with phantom points must state it.
    splits_corners : bool
        Whether refined face ``h`` is a quadrilateral at the face corner ``h`` of the mesh before, and begins there. If
        so, cages with many classes of patches are refined once, which saves time. False by default.
    has_convex_rules : bool
        Whether no weight of the rules, or of the regular basis, is negative: then the surface over an element lies in
        the convex hull of its one-ring, which saves time where adaptive tessellations are chosen. False by default.
    has_local_borders : bool
        Whether a vertex on a border, or a corner, takes weights of its neighbours on the border only, and no weight
        depends on its valence. If so, faces that lie far away in its fan are left out (`TaggedFan.near`), which saves
        time. False by default.
    crease_method : "uniform" or "chaikin", or None
        Decay of semi-sharp features in `refine`. With None, the default, the scheme refuses semi-sharp features.
    triangle_rule : "catmull_clark" or "smooth", or None
        Rule of `refine` for triangles. With None, the default, a cage with "smooth" is an error.
    """

    name: str
    element: ElementKind
    domain: ParameterDomain
    regular_face_size: int
    regular_valence: int
    regular_lattice: FloatArray
    first_edge: FloatArray
    edge_turn: FloatArray
    phantom_points: tuple[PhantomPoint, ...] | None = None
    regular_border_faces: int = 0
    splits_corners: bool = False
    has_convex_rules: bool = False
    has_local_borders: bool = False
    crease_method: CreaseMethod | None = None
    triangle_rule: TriangleRule | None = None

    def __repr__(self) -> str:
        # With the rules that a cage has set in place of the scheme's own.
        rules = [f'{name}="{vars(self)[name]}"' for name in ("crease_method", "triangle_rule") if name in vars(self)]
        return f"{type(self).__name__}({', '.join(rules)})"

    @property
    def has_phantom_points(self) -> bool:
        """Whether there are rules at borders and sharp features: for open cages, and cages with creases or corners."""
        return self.element == "face" and self.phantom_points is not None

    def unsupported(self, topology: Topology) -> Unsupported | None:  # noqa: ARG002
        """Say which faces or vertices of a mesh the rules do not cover; None, the default, if they cover all."""
        return None

    @abstractmethod
    def refine(self, topology: Topology) -> Refinement:
        """Apply the rules once to a whole mesh of supported faces and vertices; for stencils see `StencilTable.of`.

        The numbers of refined faces and vertices must not depend on semi-sharpness.
        """

    @abstractmethod
    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[AffineMap, int]]:
        """Parts of the element named by a half-edge after one refinement.

        A part is given by the map from the element's parameters to its own, and by the half-edge of the refined mesh
        that names it. There are four, the copies of the domain, or one, with the identity, where an element has
        another number of corners than the domain (a corner of an n-gon under Catmull-Clark).
        """

    @abstractmethod
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


def kept_rules(topology: Topology, new_count: int) -> NDArray[np.int8] | None:
    """Vertex rules after a refinement that keeps the vertices and appends new ones."""
    if topology.rules is None:
        return None
    return np.concatenate([topology.rules, np.zeros(new_count, dtype=np.int8)])


def kept_sharpness(
    topology: Topology,
    # (n_h',) int: of the refined mesh. The faces at old corners come first, each listed from the old vertex on.
    face_vertices: NDArray[np.integer],
    last: int,  # Place of the last edge in each of these faces. The first edge and the last are halves of old edges.
    new_count: int,  # Number of vertices that are new
    method: CreaseMethod,
) -> SemiSharpness | None:
    """Semi-sharp features after a refinement that keeps the vertices and makes a face at every corner of the mesh."""
    semi, t = topology.semi_sharpness, topology
    if semi is None:
        return None
    edges = np.zeros(len(face_vertices))
    corners = edges[: t.half_edge_count * (last + 1)].reshape(t.half_edge_count, last + 1)
    corners[:, 0] = semi.edges_refined
    ahead = t.turn(np.arange(t.half_edge_count))
    corners[:, last] = np.where(ahead < 0, 0, semi.edges_refined[ahead])
    return semi.refined(face_vertices, edges, new_count, method)


def low_valence(topology: Topology, least: int) -> Unsupported | None:
    """Interior vertices of a valence below the least that a scheme supports."""
    inside = ~topology.is_border_vertex & (topology.vertex_face_count > 0)
    low = np.flatnonzero(inside & (topology.vertex_face_count < least))
    if not len(low):
        return None
    return Unsupported("vertex", low, f"has valence {topology.vertex_face_count[low[0]]}", f"valence {least} or more")


def tensor_basis(u: FloatArray, v: FloatArray, derivatives: int) -> FloatArray:
    """Products of the values and derivatives ``(derivatives + 1, s, r)`` of one-dimensional bases along u and v.

    Returns (1 | 3 | 6, s, r * r), u fastest, in the order of `Scheme.regular_basis`.
    """
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)][: (derivatives + 1) * (derivatives + 2) // 2]
    count = u.shape[1:]
    # Samples come last, so that NumPy's loops are long.
    u, v = (np.ascontiguousarray(each.swapaxes(1, 2)) for each in (u, v))
    products = np.empty((len(orders), v.shape[1], count[1], count[0]), dtype=u.dtype)
    for product, (a, b) in zip(products, orders, strict=True):
        np.multiply(v[b][:, None], u[a], out=product)
    return np.ascontiguousarray(products.reshape(len(orders), -1, count[0]).swapaxes(1, 2))

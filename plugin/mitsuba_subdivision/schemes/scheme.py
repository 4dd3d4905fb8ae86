"""Base class of subdivision schemes, and functions that the rules of several schemes share."""

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
    """A scheme cannot be used: it is unknown or invalid, or its rules do not support a cage."""


class Refinement(NamedTuple):
    """One application of a scheme's rules.

    Attributes
    ----------
    topology : Topology
        The refined mesh.
    stencils : StencilTable
        The refined vertices as weighted sums of the coarse vertices.
    """

    topology: Topology
    stencils: StencilTable

    def apply(self, points: FloatArray) -> FloatArray:
        """Return the refined points, ``(n_new, k)``, of coarse points."""
        return self.stencils.matrix @ points


class PhantomPoint(NamedTuple):
    """A control point beyond the border, as a combination of control points inside the mesh.

    With phantom points a patch beside the border is a regular patch, with the same limit surface as the border masks.

    Attributes
    ----------
    offsets : tuple of (2,)
        Lattice steps from the phantom point to the control points that are combined.
    weights : tuple of float
        Weights of these control points; they sum to one.
    """

    offsets: tuple[tuple[float, float], ...]
    weights: tuple[float, ...]


class Unsupported(NamedTuple):
    """Faces or vertices that the rules of a scheme do not support.

    Attributes
    ----------
    kind : "face" or "vertex"
    indices : (n,) int64
        0-based indices of these faces or vertices, at least one.
    problem : str
        Problem of the first one, such as "has 5 corners".
    expected : str
        Supported meshes, such as "triangles only".
    """

    kind: Literal["face", "vertex"]
    indices: IntArray
    problem: str
    expected: str


class Scheme(ABC):
    """Base class of stationary subdivision schemes: refinement rules, regular basis and parameter domain.

    Everything else is derived by running `refine` on local meshes. Scheme objects are cache keys of derived data, so
    they must be hashable and immutable. The ``crease_method`` and ``triangle_rule`` of a cage are set on a copy.
    `check_scheme` tests the rules of a scheme.

    Attributes
    ----------
    name : str
    element : "face" or "vertex"
        The elements, which have a parameter domain each: faces or vertices of the cage.
    domain : ParameterDomain
        `SQUARE` or `TRIANGLE`, with as many corners as a regular face, or as a regular vertex has faces.
    regular_face_size, regular_valence : int
        The limit surface is polynomial over a one-ring that has only faces of this size and vertices of this valence.
    regular_lattice : (R, 2) float64
        Parameters of the control points of the regular patch.
    first_edge : (2, 2) float64
        Lattice points at the two ends of the half-edge that names the regular element.
    edge_turn : (2, 2) float64
        Matrix that maps a lattice edge of a regular face to the next edge of the face.
    phantom_points : tuple of PhantomPoint, or None
        Rules for the control points of a regular patch beyond the border; empty if there are no such points. With None,
        the default, a scheme whose elements are faces refuses open cages and infinitely sharp creases and corners.
    regular_border_faces : int
        Number of regular faces at a border vertex beside which the limit surface is polynomial; at a corner it is one.
        Required with phantom points.
    splits_corners : bool
        Whether refined face ``h`` is a quadrilateral at the coarse face corner ``h``, and begins there. If so, cages
        with many classes of patches are refined once, which saves time. False by default.
    has_convex_rules : bool
        Whether no weight of the rules and of the regular basis is negative. If so, the surface over an element lies in
        the convex hull of its one-ring, which saves time in adaptive tessellation. False by default.
    has_local_borders : bool
        Whether the mask of a border vertex or a corner has weights for its neighbours on the border only, and no weight
        depends on its valence. If so, distant faces of its fan are left out (`Fan.near`), which saves time. False
        by default.
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
        # Include the rules that a cage has set.
        rules = [f'{name}="{vars(self)[name]}"' for name in ("crease_method", "triangle_rule") if name in vars(self)]
        return f"{type(self).__name__}({', '.join(rules)})"

    @property
    def has_phantom_points(self) -> bool:
        """Whether the scheme supports open cages, and cages with creases or corners."""
        return self.element == "face" and self.phantom_points is not None

    def unsupported(self, topology: Topology) -> Unsupported | None:  # noqa: ARG002
        """Return the faces or vertices of a mesh that the rules do not support; None (default) if there are none."""
        return None

    @abstractmethod
    def refine(self, topology: Topology) -> Refinement:
        """Apply the rules once to a whole mesh of supported faces and vertices; for stencils see `StencilTable.of`.

        The numbers of refined faces and vertices must not depend on semi-sharpness.
        """

    @abstractmethod
    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[AffineMap, int]]:
        """Return the children of an element, which is named by a half-edge, after one refinement.

        A child consists of the map from the element's parameters to the child's, and the half-edge of the refined mesh
        that names it. There are four children, one for each copy of the domain, or one child with the identity if the
        element does not fit the domain (a corner of an n-gon under Catmull-Clark).
        """

    @abstractmethod
    def regular_basis(self, uv: FloatArray, derivatives: int) -> FloatArray:
        """Return weights of the regular patch's control points, in the order of `regular_lattice`.

        Parameters
        ----------
        uv : (s, 2) float
            The result has the same precision.
        derivatives : 0, 1 or 2

        Returns
        -------
        (1, s, R), (3, s, R) or (6, s, R)
            Value; d/du, d/dv; d2/du2, d2/dudv, d2/dv2.
        """


def kept_rules(topology: Topology, new_count: int) -> NDArray[np.int8] | None:
    """Return the vertex rules after a refinement that keeps the vertices and appends new ones."""
    if topology.rules is None:
        return None
    return np.concatenate([topology.rules, np.zeros(new_count, dtype=np.int8)])


def kept_sharpness(
    topology: Topology,
    # (n_h',) int: `Topology.face_vertices` of the refined mesh. The faces at coarse corners come first, each listed
    # from the coarse vertex on.
    face_vertices: NDArray[np.integer],
    # Index of the last edge in each of these faces. The first and the last edge are halves of coarse edges.
    last: int,
    new_count: int,  # Number of appended vertices
    method: CreaseMethod,
) -> SemiSharpness | None:
    """Return the semi-sharp features after a refinement that keeps the vertices and creates a face at every corner."""
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
    """Return inner vertices of a valence below the least that a scheme supports, as `Scheme.unsupported`."""
    inside = ~topology.is_border_vertex & (topology.vertex_face_count > 0)
    low = np.flatnonzero(inside & (topology.vertex_face_count < least))
    if not len(low):
        return None
    return Unsupported("vertex", low, f"has valence {topology.vertex_face_count[low[0]]}", f"valence {least} or more")


def tensor_basis(u: FloatArray, v: FloatArray, derivatives: int) -> FloatArray:
    """Multiply the values and derivatives ``(derivatives + 1, s, r)`` of one-dimensional bases along u and v.

    Returns (1 | 3 | 6, s, r * r), u fastest, in the order of `Scheme.regular_basis`.
    """
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)][: (derivatives + 1) * (derivatives + 2) // 2]
    count = u.shape[1:]
    # Samples are along the last axis, so that NumPy's inner loops are long.
    u, v = (np.ascontiguousarray(basis.swapaxes(1, 2)) for basis in (u, v))
    products = np.empty((len(orders), v.shape[1], count[1], count[0]), dtype=u.dtype)
    for product, (a, b) in zip(products, orders, strict=True):
        np.multiply(v[b][:, None], u[a], out=product)
    return np.ascontiguousarray(products.reshape(len(orders), -1, count[0]).swapaxes(1, 2))

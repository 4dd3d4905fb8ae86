"""Base class of subdivision schemes, refinements as tables of stencils, and the registry of schemes by name."""

from __future__ import annotations

from abc import ABC, abstractmethod
from copy import copy
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..mesh import ragged
from ..mesh.connectivity import CreaseMethod, IntArray, Topology
from ..mesh.signature import ElementKind
from .domain import FloatArray, ParameterDomain, ParameterMap

if TYPE_CHECKING:
    from scipy import sparse  # Importing SciPy's sparse arrays takes 0.1 s and 20 MB, and local meshes do not need them

_SCHEMES: dict[str, Scheme] = {}

TriangleRule = Literal["catmull_clark", "smooth"]  # How Catmull-Clark refines triangles


class SchemeError(ValueError):
    """A scheme cannot be used: it is unknown or invalid, or its rules do not support a cage."""


@dataclass(frozen=True, eq=False)
class StencilTable:
    """Stencils of refined vertices, as a sparse table of weights.

    Parameters
    ----------
    row_count, column_count : int
        Number of vertices after the refinement, and before it.
    rows, columns : (n,) int
        For each entry, the refined vertex and the coarse vertex. Entries with the same row and column add up.
    weights : (n,) float64
        Weight of each entry. The weights of a row sum to one.
    """

    row_count: int
    column_count: int
    rows: IntArray
    columns: IntArray
    weights: FloatArray

    @classmethod
    def of(cls, row_count: int, column_count: int, *entries: tuple[NDArray, NDArray, NDArray | float]) -> StencilTable:
        """Create a table from several (rows, columns, weights). Entries with the same row and column add up."""
        # int32 halves the memory, as faces with n corners have n² entries, and saves a conversion in `matrix`. Vertices
        # of a cage that is refined once fit into it.
        rows = np.concatenate([r for r, _, _ in entries], dtype=np.int32, casting="same_kind")
        columns = np.concatenate([c for _, c, _ in entries], dtype=np.int32, casting="same_kind")
        weights = np.concatenate([np.broadcast_to(w, len(r)) for r, _, w in entries])
        return cls(row_count, column_count, rows, columns, weights)

    @classmethod
    def from_matrix(cls, matrix: sparse.coo_array | sparse.csc_array | sparse.csr_array) -> StencilTable:
        """Create a table from the rows of a sparse array."""
        entries = matrix.tocoo()
        row_count, column_count = entries.shape
        return cls(row_count, column_count, entries.row, entries.col, entries.data)

    @cached_property
    def matrix(self) -> sparse.csr_array:
        """``(row_count, column_count)`` sparse array with a stencil in each row."""
        from scipy import sparse

        rows, columns = (indices.astype(np.int32, copy=False) for indices in (self.rows, self.columns))
        return sparse.coo_array((self.weights, (rows, columns)), (self.row_count, self.column_count)).tocsr()

    def entries(self, rows: IntArray) -> tuple[IntArray, IntArray, FloatArray]:
        """Return index in ``rows``, column and weight of the entries of refined vertices, in the order of ``rows``."""
        counts = np.bincount(self.rows, minlength=self.row_count)
        lengths = counts[rows]
        entries = np.argsort(self.rows, kind="stable")[ragged.ranges(ragged.starts(counts)[rows], lengths)]
        return np.repeat(np.arange(len(rows)), lengths), self.columns[entries], self.weights[entries]


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
    def children(self, topology: Topology, refined: Topology, half_edge: int) -> list[tuple[ParameterMap, int]]:
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


def tensor_basis(u: FloatArray, v: FloatArray, derivatives: int) -> FloatArray:
    """Return `Scheme.regular_basis` of products of bases ``(derivatives + 1, r, s)`` along u and v, u fastest."""
    orders = [(0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)][: (derivatives + 1) * (derivatives + 2) // 2]
    size, count = u.shape[1:]
    # Samples are along the last axis in memory, so that NumPy's inner loops are long.
    products = np.empty((len(orders), size, size, count), dtype=u.dtype)
    for product, (a, b) in zip(products, orders, strict=True):
        np.multiply(v[b][:, None], u[a], out=product)
    return products.reshape(len(orders), size**2, count).swapaxes(1, 2)


def scheme_named(name: str) -> Scheme:
    """Return the scheme of a name. Raises a SchemeError that lists the known names if there is none."""
    if name not in _SCHEMES:
        raise SchemeError(f'unknown scheme "{name}"; known schemes: {", ".join(sorted(_SCHEMES))}')
    return _SCHEMES[name]


@lru_cache(maxsize=256)
def with_rules(scheme: Scheme, crease_method: str, triangle_rule: str) -> Scheme:
    """Return the scheme with the rules of a cage: a copy, or the scheme itself if it has these rules.

    Raises SchemeError if the scheme does not support them. Only Catmull-Clark has another rule for triangles.
    """
    rules = {"crease_method": (crease_method, "uniform"), "triangle_rule": (triangle_rule, "catmull_clark")}
    changed = {name: rule for name, (rule, default) in rules.items() if rule != (getattr(scheme, name) or default)}
    for name, rule in changed.items():
        if getattr(scheme, name) is None:
            raise SchemeError(f'the scheme {scheme.name} has no {name} "{rule}"')
    if not changed:
        return scheme
    scheme = copy(scheme)
    vars(scheme).update(changed)
    return scheme


def register_scheme(scheme: Scheme) -> None:
    """Register a scheme under its name, for `LimitSurface` and scenes. Replaces a scheme of the same name.

    Parameters
    ----------
    scheme : Scheme
        Its methods must always return the same results, as derived data is cached. `check_scheme` tests its rules.

    Raises
    ------
    SchemeError
        If it is not a `Scheme`, or has no name.
    """
    require_scheme(scheme)
    _SCHEMES[scheme.name] = scheme


def require_scheme(scheme: object) -> None:
    """Raise SchemeError unless an object is a scheme with a name."""
    if not isinstance(scheme, Scheme):
        label = f"the class {scheme.__name__}" if isinstance(scheme, type) else repr(scheme)
        raise SchemeError(f"scheme {label}; expected a scheme's name, or an object of a class derived from Scheme")
    if not isinstance(getattr(scheme, "name", None), str) or not scheme.name:
        raise SchemeError(f"{type(scheme).__name__} has no name; expected a string of one or more characters")

"""The limit surface of a control cage."""

from __future__ import annotations

import numbers
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property, partial
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..cage import TEXCOORDS, CageError, ControlCage, attributes_by_name
from ..evaluation.element import SurfaceSamples, derivative_stencils
from ..evaluation.equations import AT_EXTRAORDINARY_POINT, Evaluator
from ..evaluation.located_samples import limit_stencils
from ..mesh.shared import shared_by_key
from ..patches.area_samples import AreaSamples, SamplingCells, surface_areas, uniform_locations
from ..patches.channel import Channel, ChannelLayout
from ..patches.closest_points import ClosestPoints, ClosestPointSearch
from ..patches.energies import Density, energy_matrix, gradients, hessians
from ..patches.patch_samples import PatchSampler, StencilMatrices, stencil_matrices
from ..patches.patch_table import PatchTable
from ..patches.piece_table import PieceTable
from ..patches.polynomial_pieces import ElementBounds, SurfacePieces
from ..refinement.adapted_scheme import adapted_scheme
from ..schemes import FloatArray, Scheme
from ..tessellation.attribute_table import AttributeLayout, attribute_table
from ..tessellation.uniform import uniform_table
from ..tessellation.vertex_table import Tessellation, VertexMatrices, VertexTable
from ..variants import variant_name
from .arguments import checked_elements, checked_form, checked_samples, require_derivatives, require_valences

if TYPE_CHECKING:
    from scipy import sparse

    from ..kernels.surface_kernel import SurfaceKernel
    from ..tessellation.criterion import Criterion


@dataclass(frozen=True, eq=False)
class LimitSurface:
    """The limit surface of a cage under a subdivision scheme, evaluated exactly.

    Parameters
    ----------
    cage : ControlCage
    scheme : str or Scheme, optional
        "catmull_clark", "loop", "doo_sabin", the name of a registered scheme, or an object with its rules. By
        default the one that the cage's file names, or else "catmull_clark".

    Attributes
    ----------
    cage : ControlCage
    scheme : Scheme
        With the rules of the cage.

    Raises
    ------
    CageError
        If the cage is no `ControlCage`.
    SchemeError
        If the scheme is unknown, has no rules for a face, a vertex or a tag of the cage, or makes no surface of it.

    Warns
    -----
    CageWarning
        If the cage's file names another scheme.
    """

    cage: ControlCage
    scheme: Scheme

    def __init__(self, cage: ControlCage, scheme: str | Scheme | None = None) -> None:
        if not isinstance(cage, ControlCage):
            raise CageError(f"cage {cage!r}; expected a ControlCage")
        object.__setattr__(self, "cage", cage)
        object.__setattr__(self, "scheme", adapted_scheme(cage, scheme))

    def __reduce__(self) -> tuple[type[LimitSurface], tuple[ControlCage, Scheme]]:
        # The cached sampler holds locks, which cannot be pickled. A copy prepares its own.
        return LimitSurface, (self.cage, self.scheme)

    @cached_property
    def patches(self) -> PatchTable:
        """The cage's patches, grouped by class; the same for all surfaces of the same topology, tags and rules.

        Raises CageError if a vertex or a face has too high a valence.
        """

        def make() -> PatchTable:
            require_valences(self.cage, self.scheme)
            cut, count = self.cage.cut_mesh, self.cage.vertex_count
            if self.scheme.element == "face":
                return PatchTable(cut.topology, self.scheme, self.cage.is_hole, cut.vertex, count)
            # Sharpness at a non-manifold vertex has no meaning where vertices do not stay.
            return PatchTable(cut.topology.with_rules(None, None), self.scheme, None, cut.vertex, count)

        return shared_by_key((PatchTable, self.cage.structure, self.scheme), make)

    def evaluate(
        self,
        element: ArrayLike,
        uv: ArrayLike,
        corner: ArrayLike = 0,
        evaluator: Evaluator = "stabilized",
        dtype: DTypeLike = np.float64,
        derivatives: int = 1,
    ) -> SurfaceSamples:
        """Evaluate points, derivatives and normals.

        Parameters
        ----------
        element : (s,) int
            0-based base faces; for Doo-Sabin, vertices, after which come further fans of those that have several.
            ``element``, ``uv`` and ``corner`` broadcast.
        uv : (s, 2) float
            In the unit square, for Loop the unit triangle. (0, 0) is the element's corner ``corner``, (1, 0) the next
            one; where an element does not have four corners, (1, 0) is the middle between them, and (1, 1) its centre.
            Doo-Sabin's corners are the centres of the faces around the vertex, from the face of least index on.
        corner : (s,) int
            0-based. Parameters near a corner other than 0 lose no precision when counted from it.
        evaluator : "power" | "stam" | "stabilized" | "limit"
            Near extraordinary points: powers of the subdivision matrix, equation (4); Stam's form, (9) and (11); its
            stabilised form, (10) and (12), with (13) at the point itself; or (13) for every sample of an irregular
            patch. Powers and Stam's form have no value at the point itself: not a number.
        dtype : float64 or float32
            Precision of the evaluation; control points are rounded to it first.
        derivatives : 1 or 2
            2 adds second derivatives and curvature. The stabilised form computes curvature in the frame of the limit
            normal, where tangential terms do not hide it.

        Returns
        -------
        SurfaceSamples

        Raises
        ------
        ValueError
            If an index or a parameter is out of range, or an option is unknown.
        """
        dtype = checked_form(evaluator, dtype)
        require_derivatives(derivatives)
        half_edge, uv = checked_samples(self.patches, element, uv, corner)
        return self._sampler.evaluate(half_edge, uv, evaluator, dtype, derivatives)

    @cached_property
    def _sampler(self) -> PatchSampler:
        return PatchSampler(self.patches, self.cage.positions)

    def matrix(self, element: ArrayLike, uv: ArrayLike, corner: ArrayLike = 0, derivatives: int = 1) -> StencilMatrices:
        """Weights of the control points at samples, as sparse matrices: `evaluate` as linear maps.

        Parameters
        ----------
        element, uv, corner
            As for `evaluate`.
        derivatives : 1 or 2
            2 adds second derivatives.

        Raises
        ------
        ValueError
            As `evaluate`.
        """
        require_derivatives(derivatives)
        half_edge, uv = checked_samples(self.patches, element, uv, corner)
        stencils = partial(derivative_stencils, derivatives=derivatives)
        return StencilMatrices(*stencil_matrices(self.patches, half_edge, uv, stencils, 3 * derivatives))

    def evaluate_attribute(self, name: str, element: ArrayLike, uv: ArrayLike, corner: ArrayLike = 0) -> FloatArray:
        """Evaluate an attribute of the cage, exactly: the limit of its refinement.

        Parameters
        ----------
        name : str
            "texcoords", or a name in `ControlCage.attributes`.
        element, uv, corner
            As for `evaluate`. Across a seam, values are those of ``element``.

        Returns
        -------
        (s, k) float64

        Raises
        ------
        ValueError
            If the cage has no such attribute, or an index or a parameter is out of range.
        SchemeError
            If the scheme has no rules for the attribute.
        """
        return self.channel(name).evaluate(*checked_samples(self.patches, element, uv, corner))

    @property
    def attribute_names(self) -> tuple[str, ...]:
        """Names of the cage's attributes; of its texture coordinates first, if it has any."""
        return tuple(attributes_by_name(self.cage.texcoords, self.cage.attributes))

    def channel(self, name: str) -> Channel:
        """The interpolation of an attribute, or of the texture coordinates ("texcoords"), over the elements.

        Repeated calls return the same object. Raises ValueError without such an attribute, SchemeError without rules.
        """
        if name not in self._channels:
            attributes = attributes_by_name(self.cage.texcoords, self.cage.attributes)
            if name not in attributes:
                expected = f"one of {', '.join(attributes)}" if attributes else "a cage with attributes"
                raise ValueError(f'{self.cage.source.name} has no attribute "{name}"; expected {expected}')
            layout = ChannelLayout.of(name, attributes[name], self.cage, self.scheme, self.patches)
            self._channels[name] = Channel(layout, attributes[name].values)
        return self._channels[name]

    @cached_property
    def _channels(self) -> dict[str, Channel]:
        return {}

    def bounds(self, element: ArrayLike | None = None) -> ElementBounds:
        """Axis-aligned bounding boxes of the surface over each element; they also contain its rounding to float32.

        Their diagonals are at most 5 % longer than those of the tight boxes.

        Parameters
        ----------
        element : (e,) int, optional
            0-based, as for `evaluate`. By default all elements that have a surface: no holes, no boundary vertices.

        Raises
        ------
        ValueError
            If an index is out of range.
        SchemeError
            If the scheme's regular patches are no polynomials, or its refinement does not separate irregularities or
            does not divide domains as the built-in schemes do.
        """
        sizes = self.patches.elements.face_sizes
        chosen = np.flatnonzero(sizes) if element is None else checked_elements(self.patches, element)
        return ElementBounds(chosen, *(side[chosen] for side in self._surface_pieces.element_bounds))

    def area(self) -> float:
        """Area of the surface, in squared units of the cage's space.

        Computed by Gauss quadrature of every polynomial piece, at all levels around extraordinary points, to a relative
        accuracy of 1e-12; where it is folded along a curve inside an element, to about 1e-8 of the pieces there. Raises
        SchemeError as `bounds`.
        """
        areas, rest = self._areas
        return float(sum(part_areas.sum() for part_areas in areas) + rest)

    def stiffness(self, order: int = 4) -> sparse.csr_array:
        """Stiffness matrix of the surface: Dirichlet's energy of functions that are subdivided as points are.

        Entry ``(i, j)`` is the integral over the limit surface of the product of the gradients, in the surface's own
        metric, of the basis functions of control points i and j. It is the Laplace-Beltrami operator in weak form. Its
        product with the control points is the gradient of `area` by them. It does not depend on the surface's size.

        Parameters
        ----------
        order : int
            Nodes of the Gauss rule along each parameter of a polynomial piece. Around extraordinary points, levels are
            summed until a millionth of the energy there is left.

        Returns
        -------
        (n_v, n_v) CSR array of float64
            Symmetric, positive semi-definite. Constants are in its null space.

        Raises
        ------
        ValueError
            If the order is no integer or below 1.
        SchemeError
            As `bounds`.
        """
        return self._energy(gradients, order)

    def bending(self, order: int = 4) -> sparse.csr_array:
        """Bending matrix of the surface: thin-plate energy of functions that are subdivided as points are.

        Entry ``(i, j)`` is the integral over the limit surface of the inner product of the covariant second
        derivatives, in the surface's own metric, of the basis functions of control points i and j. For the control
        points themselves, the energy is the integral of the squares of both principal curvatures. Creases cost nothing.
        The matrix is proportional to one over the square of the surface's size. The energy is infinite at some
        vertices, such as one with a single face on a smooth border: the surface nearest to these is left out.

        Parameters
        ----------
        order : int
            As for `stiffness`.

        Returns
        -------
        (n_v, n_v) CSR array of float64
            Symmetric, positive semi-definite. Constants are in its null space, and coordinates of a flat surface.

        Raises
        ------
        ValueError
            If the order is no integer or below 1.
        SchemeError
            As `bounds`.
        """
        return self._energy(hessians, order)

    def _energy(self, density: Density, order: int) -> sparse.csr_array:
        if not isinstance(order, numbers.Integral) or order < 1:
            raise ValueError(f"order {order!r}; expected an integer of 1 or more")
        return energy_matrix(self.patches, self.cage.positions, density, int(order))

    def sample(self, count: int, seed: int | np.random.Generator = 0) -> AreaSamples:
        """Draw independent random points, uniform by area.

        Parameters
        ----------
        count : int
        seed : int or numpy.random.Generator
            The same integer gives the same points.

        Raises
        ------
        ValueError
            If the count is no integer or negative, or the surface has no area.
        SchemeError
            As `bounds`.
        """
        if not isinstance(count, numbers.Integral) or count < 0:
            raise ValueError(f"count {count!r}; expected an integer of 0 or more")
        if not self.area() > 0:
            raise ValueError(f"{self.cage.source.name}: the surface has no area; expected one to draw points from")
        half_edge, uv = uniform_locations(self._surface_pieces, self._areas[0], int(count), np.random.default_rng(seed))
        samples = self._sampler.evaluate(half_edge, uv)
        return AreaSamples(*self._element_and_corner(half_edge), uv, samples.p, samples.n, samples.dp_du, samples.dp_dv)

    def closest_point(self, points: ArrayLike) -> ClosestPoints:
        """Find the nearest point of the surface for each given point; where several are nearest, one of them.

        The distance is a global minimum. The first call prepares a search.

        Parameters
        ----------
        points : (s, 3) float
            In the cage's space.

        Returns
        -------
        ClosestPoints
            The difference of a point and its nearest point is along the normal at the latter, unless that lies on a
            border, on a crease, or at a vertex where the surface is not smooth.

        Raises
        ------
        ValueError
            If the points are no finite ``(s, 3)``.
        SchemeError
            As `bounds`.
        """
        points = np.asarray(points, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or not np.isfinite(points).all():
            raise ValueError(f"points of shape {points.shape}; expected (s, 3), all of them finite")
        half_edge, uv = self._closest_point_search.nearest(points)
        samples = self._sampler.evaluate(half_edge, uv)
        distance = np.linalg.norm(points - samples.p, axis=1)
        return ClosestPoints(*self._element_and_corner(half_edge), uv, samples.p, samples.n, distance)

    @cached_property
    def _surface_pieces(self) -> SurfacePieces:
        return SurfacePieces.build(self.patches, self.cage.positions[self.patches.control_of_vertex])

    @cached_property
    def _areas(self) -> tuple[list[FloatArray], float]:
        return surface_areas(self._surface_pieces)

    @cached_property
    def _closest_point_search(self) -> ClosestPointSearch:
        return ClosestPointSearch(self._surface_pieces)

    def _element_and_corner(self, half_edge: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        element = self.patches.elements.face[half_edge].astype(np.int64)
        return element, half_edge - self.patches.elements.face_offsets[element]

    def pieces(self) -> PieceTable:
        """Prepare evaluation anywhere on a device: all data that does not depend on the control points' positions.

        Surfaces of the same topology, tags and rules share the object while a surface that called this method exists.
        Raises SchemeError as `bounds`.
        """
        return self._pieces

    @cached_property
    def _pieces(self) -> PieceTable:
        return PieceTable.build(self.patches)

    def on_device(self, variant: ModuleType | str) -> SurfaceKernel:
        """The surface on a device: evaluated at any parameters, and intersected by rays, in the variant's precision.

        Points that single precision cannot tell from an extraordinary vertex have its normal, in every variant.

        Parameters
        ----------
        variant : module or str
            ``mitsuba`` with a variant set, a variant such as ``mitsuba.llvm_ad_rgb``, or its name, "llvm_ad_rgb". It
            determines backend, precision and derivatives.

        Returns
        -------
        SurfaceKernel
            With the cage's control points, until `SurfaceKernel.set_control_points`.

        Raises
        ------
        ValueError
            If the variant is unknown or scalar, or none is set.
        SchemeError
            As `pieces`.
        """
        from ..kernels.array_types import float_type_of
        from ..kernels.surface_kernel import SurfaceKernel

        float_type = float_type_of(variant_name(variant))
        kernel = SurfaceKernel(
            self.pieces(), float_type, cells=lambda: SamplingCells.build(self._surface_pieces, self._areas[0])
        )
        kernel.set_control_points(self.cage.positions)
        return kernel

    def sampling(self, rate: int = 8) -> VertexTable:
        """Prepare a tessellation: all data that does not depend on the control points' positions.

        Surfaces of the same topology, tags and rules share the table of a rate while it is referenced.
        """
        return uniform_table(self.patches, rate)

    def adaptive_sampling(
        self, criterion: Criterion, max_rate: int = 64, control_points: FloatArray | None = None
    ) -> VertexTable:
        """Prepare an adaptive tessellation: few triangles that satisfy a criterion at the control points' positions.

        Parameters
        ----------
        criterion : Criterion
        max_rate : int
            Most segments along an edge of the cage, 1 to 1,024; rounded down to a power of two. Around extraordinary
            vertices, rings get as small as the criterion requires, each with at most half as many segments along it.
        control_points : (n, 3) float64, optional
            Positions for the criterion; by default the cage's.

        Raises
        ------
        ValueError
            If ``max_rate`` is out of range, or the control points are not finite or not as many as the cage's.
        MemoryError
            If the tessellation would not fit into memory.

        Warns
        -----
        CageWarning
            If parts of the surface need more than ``max_rate`` segments, except by a criterion for outlines.
        """
        points, shape = self.cage.positions, self.cage.positions.shape
        if control_points is not None:
            points = np.asarray(control_points, dtype=np.float64)
            if points.shape != shape or not np.isfinite(points).all():
                raise ValueError(f"control points of shape {points.shape}; expected finite ones of shape {shape}")
        from ..tessellation.adaptive import adaptive_table

        return adaptive_table(self.patches, points, criterion, max_rate, self.cage.source.name)

    def tessellate(
        self,
        rate: int = 8,
        evaluator: Evaluator = "stabilized",
        dtype: DTypeLike = np.float64,
        sample_offset: float = 0.0,
    ) -> Tessellation:
        """Sample the surface into triangles with exact points and normals.

        Parameters
        ----------
        rate : int
            Segments per edge of the cage, at least 1.
        evaluator : "power" | "stam" | "stabilized" | "limit"
            As for `evaluate`. Forms other than "stabilized" serve to show their errors.
        dtype : float64 or float32
            Precision of the evaluation.
        sample_offset : float
            Vertices at extraordinary points are sampled at ``u = v = sample_offset`` instead of at the point itself,
            where powers and Stam's form have no value.

        Raises
        ------
        ValueError
            If the rate is no integer or below 1, or the offset is not in [0, 1), or 0 where the form needs another.
        MemoryError
            If the triangles would not fit into memory; the message names a rate that would.
        SchemeError
            If the scheme has no rules for an attribute of the cage.
        """
        table = self.sampling(rate)
        positions, normals = self.sample_vertices(table, evaluator, dtype, sample_offset)
        mesh, shared_values = self.attribute_table(table)
        values = {name: attribute_values.copy() for name, attribute_values in shared_values.items()}
        texcoords = values.pop(TEXCOORDS, None)
        vertices = mesh.gathered(positions), mesh.gathered(normals)
        return Tessellation(*vertices, mesh.triangles, table.element, texcoords, values)

    def tessellation_matrix(self, table: int | VertexTable = 8) -> VertexMatrices:
        """Weights of the control points at the vertices of a tessellation, as sparse matrices.

        Parameters
        ----------
        table : int or VertexTable
            A rate, or the result of `sampling` or `adaptive_sampling`. Vertices are in the order of
            `VertexTable.apply`, which is that of `tessellate` unless attributes have seams.

        Raises
        ------
        ValueError, MemoryError
            As `tessellate`.
        """
        if not isinstance(table, VertexTable):
            table = self.sampling(table)
        points, *tangents = stencil_matrices(self.patches, *table.locations(), limit_stencils, 3)
        return VertexMatrices(points[table.weld_target], *tangents)

    def attribute_table(
        self, table: VertexTable, names: Iterable[str] | None = None
    ) -> tuple[AttributeLayout, dict[str, FloatArray]]:
        """Evaluate the cage's texture coordinates and attributes, or those named, at the vertices of a tessellation.

        Raises SchemeError if the scheme has no rules for one of them.
        """
        channels = {name: self.channel(name) for name in (self.attribute_names if names is None else names)}
        return attribute_table(table, self.patches, channels)

    def sample_vertices(
        self, table: VertexTable, evaluator: Evaluator, dtype: DTypeLike, sample_offset: float
    ) -> tuple[FloatArray, FloatArray]:
        """``(n, 3)`` positions and normals at the vertices of a sampling table; arguments as for `tessellate`."""
        dtype = checked_form(evaluator, dtype)
        if not isinstance(sample_offset, numbers.Real) or not 0 <= sample_offset < 1:
            raise ValueError(f"sample_offset {sample_offset!r}; expected at least 0 and below 1")
        if sample_offset == 0 and evaluator in ("power", "stam"):
            problem = f'evaluator "{evaluator}" has no value at extraordinary points'
            raise ValueError(f"{problem}; expected a sample_offset above 0")
        if evaluator == "stabilized" and sample_offset == 0 and dtype == np.float64:
            return table.apply(self.cage.positions)
        half_edge, uv = table.locations()
        corners = np.flatnonzero(((uv == 0) | (uv == 1)).all(axis=1))
        level = self._sampler.evaluate(half_edge[corners], uv[corners], "stabilized", dtype).level
        moved = corners[level == AT_EXTRAORDINARY_POINT]
        # A parameter of 0 becomes the offset; one of 1, at the centre of a polygon, becomes 1 minus the offset.
        uv[moved] = np.abs(uv[moved] - sample_offset)
        samples = self._sampler.evaluate(half_edge, uv, evaluator, dtype)
        return samples.p[table.weld_target], samples.n

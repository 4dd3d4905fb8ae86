"""Sharpness of creases and corners as unknowns: control points of a refined cage, and their derivatives by sharpness.

Where no sharpness is above an integer k, nothing semi-sharp is left after k refinements. So the limit surface is that
of a smooth cage, always of the same faces, whose control points are ``R_{k-1}(s) ... R_0(s) c``: refinements that
depend on the sharpness s, times the control points c.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ..cage.control_cage import ControlCage
from ..cage.errors import CageError, in_digits
from ..cage.tags import validated_edges, validated_vertices
from ..mesh.connectivity import IntArray
from ..mesh.sharpness import Sharpness
from ..schemes import Scheme, SchemeError
from ..schemes.domain import FloatArray
from .adapted_scheme import adapted_scheme
from .cage_refinement import CageRefinement, built
from .refinement_at import FeatureSharpness, RefinementAt
from .sharpness_linearization import SharpnessLinearization
from .variable_refinement import VariableRefinement, picking, sharp_features, variable_refinement

if TYPE_CHECKING:
    from scipy import sparse

# More refinements than these would make a thousand faces and more of each.
MOST_REFINEMENTS = 6
# Of refined points whose control points are below one, by two orders of summation.
ROUNDING = 1e-12


class VariableSharpness:
    """A cage some of whose creases and corners have a sharpness that is not known yet.

    The limit surface is that of `cage` with the control points that `points` gives for any sharpness from 0 to
    ``highest``: ``cage.with_positions(variable.points(sharpness))``. Points are linear in control points, and
    polynomials in sharpness as long as no sharpness passes an integer.

    They are continuous where all that is semi-sharp at a vertex is equally sharp. Elsewhere they may jump when a
    sharpness passes an integer, 0 among them, as OpenSubdiv's rules do: a vertex takes the *mean* sharpness of what a
    refinement makes smooth there, and at integers a feature joins that mean or leaves it. With Chaikin's method, the
    averages along creases do the same.

    Derivatives at integers are one-sided: those of the piece in which every sharpness is a little higher, also at 0, so
    that an optimiser can leave 0; for a sharpness of ``highest``, a little lower.

    Parameters
    ----------
    cage : ControlCage
        Its own tags stay, but for those of the edges and corners that are given here.
    edges : (n_e, 2) array of int, optional
        0-based ends of edges whose sharpness is unknown. By default, all edges of two faces.
    corners : (n_c,) array of int, optional
        0-based vertices whose sharpness is unknown. By default there are none. Those that are corners by the boundary
        rule, or by infinitely sharp creases, stay corners whatever their sharpness.
    highest : int
        The highest sharpness, 1 to 6. `cage` is refined as many times: higher ones cost four times as much each.
    scheme : str or Scheme, optional
        As for `LimitSurface`. Doo-Sabin has no creases.

    Attributes
    ----------
    cage : ControlCage
        The given cage refined ``highest`` times. It has no semi-sharp tags but what is left of known ones. Its control
        points, texture coordinates and attributes are those for `initial`. Subdivided attributes depend on sharpness,
        as points do: `points` makes those with a value for each vertex, and ``with_sharpness(sharpness).refined()``, as
        many times, has all.
    edges : (n_e, 2) int64
    corners : (n_c,) int64
    highest : int
    initial : (n,) float64
        The given cage's own sharpness of these edges, then of these corners, or ``highest`` where it is above.
    scheme : Scheme

    Raises
    ------
    CageError
        If an edge is none of the cage, or is not between two faces; if a corner is no vertex; if something is given
        twice, or nothing that can be semi-sharp; if ``highest`` is not one of 1 to 6; with Chaikin's method, if a known
        crease is semi-sharp and above ``highest``; or as `ControlCage.refinement` does.
    SchemeError
        If the scheme has no rules for semi-sharp features, or has rules of its own for them; or as `LimitSurface` does.
    """

    cage: ControlCage
    edges: IntArray
    corners: IntArray
    highest: int
    initial: FloatArray
    scheme: Scheme

    def __init__(
        self,
        cage: ControlCage,
        edges: ArrayLike | None = None,
        corners: ArrayLike = (),
        *,
        highest: int = 3,
        scheme: str | Scheme | None = None,
    ) -> None:
        if highest not in range(1, MOST_REFINEMENTS + 1):
            raise CageError(
                f"{cage.source.name}: highest is {highest!r}; expected an integer from 1 to {MOST_REFINEMENTS}"
            )
        self.highest, self._scheme = int(highest), scheme
        t, source = cage.topology, cage.source
        half_edges = validated_edges(t, edges, source)
        self.corners = validated_vertices(t, corners, source)
        ends = [t.face_vertices[half_edges], t.face_vertices[t.next[half_edges]]]
        self.edges = np.stack(ends, axis=1).astype(np.int64)
        if not len(self):
            raise CageError(f"{cage.source.name}: no edges and no corners; expected some whose sharpness is unknown")
        self.initial = np.concatenate([cage.tags.edges[half_edges], cage.tags.vertices[self.corners]])
        self.initial = np.minimum(self.initial, self.highest)
        self._half_edges = np.stack([half_edges, t.twin[half_edges]])
        # With known tags only.
        self._given = cage
        self._given = self.with_sharpness(np.zeros(len(self)))
        self._require_known_tags_end()

        self.scheme = adapted_scheme(self.with_sharpness(np.full(len(self), self.highest)), scheme)
        self.cage = self.with_sharpness(self.initial)
        for _ in range(self.highest):
            self.cage = self.cage.refined(scheme)
        self._refine()
        self._check_rules()

    def __len__(self) -> int:
        """Number of unknown sharpnesses."""
        return len(self.edges) + len(self.corners)

    def __repr__(self) -> str:
        return f"VariableSharpness({self._given!r}, {len(self.edges)} edges, {len(self.corners)} corners)"

    def points(self, sharpness: ArrayLike, control_points: ArrayLike | None = None) -> FloatArray:
        """Control points of `cage` for some sharpness.

        They are those of the cage with these tags, refined as many times; also at integers, and where points jump.

        Parameters
        ----------
        sharpness : (n,) array
            Of `edges`, then of `corners`, from 0 to ``highest``.
        control_points : (n_v, m) array, optional
            Of the given cage; by default its own. Linear: values of any attribute at vertices may stand here.

        Returns
        -------
        (n', m) float64

        Raises
        ------
        CageError
            If there is another number of sharpnesses or points, a sharpness is out of range or not a number, or points
            are not finite.
        """
        points = self._spread @ self._checked_points(control_points)
        for step in self._at(sharpness):
            points = step.points(points)
        return self._kept @ points

    def matrix(self, sharpness: ArrayLike) -> sparse.csr_array:
        """`points` for some sharpness as weights of the control points, ``(n', n_v)`` CSR array; rows sum to one."""
        found = self._spread
        for step in self._at(sharpness):
            found = step.matrix() @ found
        return self._kept @ found

    def linearization(self, sharpness: ArrayLike, control_points: ArrayLike | None = None) -> SharpnessLinearization:
        """Derivatives of `points` there, for products in either direction; parameters and errors as for `points`."""
        points = self._spread @ self._checked_points(control_points)
        steps = self._at(sharpness, from_inside=True)
        moves = []
        for step in steps:
            moves.append(step.moves(points))
            points = step.points(points, moves[-1])
        return SharpnessLinearization(steps, moves, self._unknown, len(self._tags), self._spread, self._kept)

    def forward(
        self,
        sharpness: ArrayLike,
        control_points: ArrayLike | None = None,
        sharpness_direction: ArrayLike | None = None,
        control_points_direction: ArrayLike | None = None,
    ) -> FloatArray:
        """Derivative of `points` along a direction: `SharpnessLinearization.forward` of `linearization`."""
        return self.linearization(sharpness, control_points).forward(sharpness_direction, control_points_direction)

    def backward(
        self, sharpness: ArrayLike, control_points: ArrayLike | None, gradient: ArrayLike
    ) -> tuple[FloatArray, FloatArray]:
        """Gradients for one by `points`: `SharpnessLinearization.backward` of `linearization`."""
        return self.linearization(sharpness, control_points).backward(gradient)

    def with_sharpness(self, sharpness: ArrayLike, control_points: ArrayLike | None = None) -> ControlCage:
        """The given cage, not refined, with some sharpness as its tags.

        Parameters
        ----------
        sharpness : (n,) array
        control_points : (n_v, 3) array, optional

        Raises
        ------
        CageError
            As `points` does.
        """
        values, given = self._checked(sharpness), self._given
        edges, vertices = given.tags.edges.copy(), given.tags.vertices.copy()
        edges[self._half_edges], vertices[self.corners] = np.split(values, [len(self.edges)])
        tags = Sharpness(edges, vertices)
        contents = replace(given.contents, creases=tags.creases(given.topology), corners=tags.corners())
        if control_points is not None:
            contents = replace(contents, positions=self._checked_points(control_points))
        return built(contents)

    def refined(self, refinement: CageRefinement) -> VariableSharpness:
        """The same unknowns on a refinement of the given cage, on finer edges and one lower.

        Sharpness is one lower there, or 0, and so is ``highest``, which is at least 1. A sharpness of 0 may grow again,
        in a smaller neighbourhood.

        Parameters
        ----------
        refinement : CageRefinement
            Of `with_sharpness`, for some sharpness and control points.

        Returns
        -------
        VariableSharpness
            Of ``refinement.cage``. Its `edges` are the halves of these at their first ends, then those at their second
            ends; `corners` have the same numbers.
        """
        finer = refinement.cage.topology
        # The first of the refined faces' corners are at the ends of the old half-edges, in their order.
        halves = finer.face_sizes[0] * self._half_edges.ravel()
        edges = np.stack([finer.face_vertices[halves], finer.face_vertices[finer.next[halves]]], axis=1)
        return VariableSharpness(
            refinement.cage, edges, self.corners, highest=max(self.highest - 1, 1), scheme=self._scheme
        )

    def _require_known_tags_end(self) -> None:
        """Chaikin's method would average a known tag that is still sharp with its neighbours."""
        given, t = self._given, self._given.topology
        is_longer = (given.tags.edges > self.highest) & ~given.tags.is_infinite & (given.crease_method == "chaikin")
        for edge in np.flatnonzero(is_longer)[:1]:
            name = given.source.edge(t.face_vertices[edge], t.face_vertices[t.next[edge]])
            raise CageError(
                f"{given.source.name}: {name} has sharpness {in_digits(given.tags.edges[edge])}; expected at most the "
                f'highest, {self.highest}, with crease_method "chaikin"'
            )

    def _refine(self) -> None:
        """Prepare all refinements, and find where each feature's sharpness comes from."""
        given, t = self._given, self._given.topology
        is_known = (given.tags.edges > 0) & ~given.tags.is_infinite & (t.twin > np.arange(t.half_edge_count))
        half_edges = np.concatenate([self._half_edges[0], np.flatnonzero(is_known)])
        is_known = (given.tags.vertices > 0) & ~given.tags.is_corner
        vertices = np.concatenate([self.corners, np.flatnonzero(is_known)])
        self._tags = np.concatenate([given.tags.edges[half_edges], given.tags.vertices[vertices]])
        corners = len(half_edges) + np.arange(len(self.corners))
        self._unknown = np.concatenate([np.arange(len(self.edges)), corners])

        # With numbers, made smaller than infinite sharpness, in place of sharpness, features tell whose they are.
        scale = len(self._tags) + 1
        numbers = np.arange(1, scale) / scale
        edges, at_vertices = given.tags.edges.copy(), given.tags.vertices.copy()
        edges[half_edges] = edges[t.twin[half_edges]] = numbers[: len(half_edges)]
        at_vertices[vertices] = numbers[len(half_edges) :]
        cut = replace(given.sharp_mesh, sharpness=Sharpness(edges, at_vertices)).cut
        if cut.topology.semi_sharpness is None:
            raise CageError(
                f"{given.source.name}: all of the vertices given as corners are corners whatever their sharpness; "
                "expected some that are not"
            )
        found = np.concatenate(sharp_features(cut.topology.semi_sharpness))
        tags = np.rint(found * scale).astype(np.int64) - 1
        self._refinements: list[VariableRefinement] = []
        refined, source = cut.topology, tags
        for _ in range(self.highest):
            refinement, refined, source = variable_refinement(refined, self.scheme, source)
            self._refinements.append(refinement)

        # Half-edges of the refined cage have the numbers of those of the refined cut mesh; vertices may have others.
        kept = np.arange(self.cage.vertex_count)
        kept[self.cage.face_vertices] = refined.face_vertices
        self._spread, self._kept = picking(cut.vertex, given.vertex_count), picking(kept, refined.vertex_count)

    def _check_rules(self) -> None:
        """Compare one refinement with the scheme's own, of random points with random sharpness.

        Raises
        ------
        SchemeError
            If they differ.
        """
        rng = np.random.default_rng(0)
        sharpness, points = rng.uniform(0, self.highest, len(self)), rng.random((self._given.vertex_count, 1))
        cut = self.with_sharpness(sharpness).cut_mesh
        expected = self.scheme.refine(cut.topology).apply(points[cut.vertex])
        if np.abs(self._at(sharpness)[0].points(self._spread @ points) - expected).max() > ROUNDING:
            raise SchemeError(
                f"{self._given.source.name}: the scheme {self.scheme.name} has rules of its own for semi-sharp "
                "features; expected those of Catmull-Clark and Loop"
            )

    def _at(self, sharpness: ArrayLike, *, from_inside: bool = False) -> list[RefinementAt]:
        """Evaluate all refinements, for derivatives from within the range of sharpness."""
        values = self._checked(sharpness)
        tags, rate = self._tags.copy(), np.zeros(len(self._tags))
        tags[self._unknown] = values
        if from_inside:
            rate[self._unknown] = np.where(values < self.highest, 1, -1)
        found, refined = [], FeatureSharpness.of(tags, rate)
        for refinement in self._refinements:
            found.append(RefinementAt.of(refinement, refined.at(refinement.source)))
            refined = found[-1].refined
        return found

    def _checked(self, sharpness: ArrayLike) -> FloatArray:
        values = np.array(sharpness, dtype=np.float64)
        if values.shape != (len(self),):
            raise CageError(
                f"{self._given.source.name}: sharpness of shape {values.shape}; expected ({len(self)},), of "
                f"{len(self.edges)} edges and {len(self.corners)} corners"
            )
        for row in np.flatnonzero(~((values >= 0) & (values <= self.highest)))[:1]:
            source, at = self._given.source, row - len(self.edges)
            name = source.edge(*self.edges[row]) if at < 0 else source.vertex(self.corners[at])
            raise CageError(
                f"{source.name}: {name} has sharpness {in_digits(values[row])}; expected 0 up to the highest, "
                f"{self.highest}"
            )
        return values

    def _checked_points(self, points: ArrayLike | None) -> FloatArray:
        found = self._given.positions if points is None else np.asarray(points, dtype=np.float64)
        count = self._given.vertex_count
        if found.ndim != 2 or len(found) != count or not np.isfinite(found).all():
            raise CageError(
                f"{self._given.source.name}: control points of shape {found.shape}; expected ({count}, m), all finite"
            )
        return found

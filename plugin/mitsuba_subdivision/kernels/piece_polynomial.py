"""A piece of a patch as a polynomial: its values, derivatives and tangents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

import drjit as dr

from .domain_map import MappedParameters
from .polynomial import Polynomial

if TYPE_CHECKING:
    from ..schemes.domain import ParameterDomain


@dataclass(frozen=True, eq=False)
class PatchValues:
    """What a patch is at some parameters.

    Attributes
    ----------
    value : vector
    du, dv : vectors
        Derivatives by the parameters, as seen from the half-edge that was given. At an extraordinary point, where they
        vanish or are infinite, tangents of arbitrary length.
    tangent_u, tangent_v : vectors
        The derivatives over a positive factor, the same for both, so that they neither vanish nor overflow near
        extraordinary points.
    second : tuple of three vectors, or empty
        Derivatives by uu, uv and vv.
    """

    value: Any
    du: Any
    dv: Any
    tangent_u: Any
    tangent_v: Any
    second: tuple[Any, ...]


@dataclass(frozen=True, eq=False)
class FramePolynomials:
    """Tangents where the derivatives do not serve.

    Attributes
    ----------
    needed : mask
    is_uneven : mask
        Where the frame is that of `uneven_frame`; else the derivatives of ``others`` are the frame.
    others : Polynomial
        The point without the second eigenvector, divided by the power of the third eigenvalue.
    slow : Polynomial
        Of the second eigenvector.
    """

    needed: Any
    is_uneven: Any
    others: Polynomial
    slow: Polynomial

    def tangents(self, s: Any, t: Any, by_s: Any, by_t: Any) -> tuple[Any, Any]:
        """The frame, or the derivatives where these serve."""
        _, other_s, other_t = self.others.values(s, t, 1)
        _, slow_s, slow_t = self.slow.values(s, t, 1)
        along, across = by_s * slow_s + by_t * slow_t, other_t * slow_s - other_s * slow_t
        first = dr.select(self.is_uneven, along, other_s)
        second = dr.select(self.is_uneven, across, other_t)
        return dr.select(self.needed, first, by_s), dr.select(self.needed, second, by_t)


@dataclass(frozen=True, eq=False)
class PiecePolynomial:
    """The piece that some parameters lie in.

    Attributes
    ----------
    origin : vector
        A control value of the patch, which the polynomial is relative to.
    polynomial : Polynomial
        Of distances from the middle of the domain.
    shrinking : float array
        What the polynomial is multiplied by, except for its constant.
    parameters : MappedParameters
        In the piece.
    centre : tuple of two floats
    domain : ParameterDomain
    is_irregular : mask
    frame : FramePolynomials, or None
        Where the derivatives do not serve as tangents, what does.
    basis : list of m lists of R floats, or None
        The scheme's `PolynomialBasis.matrix`, if the piece is evaluated as published.
    """

    origin: Any
    polynomial: Polynomial
    shrinking: Any
    parameters: MappedParameters
    centre: tuple[float, float]
    domain: ParameterDomain
    is_irregular: Any
    frame: FramePolynomials | None = None
    basis: list[list[float]] | None = None

    def arrays(self) -> list:
        """All arrays of it, flat, to carry them through a loop."""
        found = [self.origin, *self.polynomial.coefficients, self.shrinking, self.is_irregular]
        found += [self.parameters.u, self.parameters.v, *self.parameters.jacobian]
        if self.frame is not None:
            frame = self.frame
            found += [frame.needed, frame.is_uneven, *frame.others.coefficients, *frame.slow.coefficients]
        return found

    def with_arrays(self, arrays: Sequence[Any]) -> PiecePolynomial:
        """A piece like this one of other `arrays`."""
        left, powers = iter(arrays), self.polynomial.powers

        def polynomial() -> Polynomial:
            return Polynomial(tuple(islice(left, len(powers))), powers)

        origin, coefficients, shrinking, is_irregular = next(left), polynomial(), next(left), next(left)
        parameters = MappedParameters(next(left), next(left), tuple(islice(left, 4)))  # type: ignore[arg-type]
        frame = None
        if self.frame is not None:
            frame = FramePolynomials(next(left), next(left), polynomial(), polynomial())
        return replace(
            self,
            origin=origin,
            polynomial=coefficients,
            shrinking=shrinking,
            is_irregular=is_irregular,
            parameters=parameters,
            frame=frame,
        )

    def seen_from_first(self, corner: Any) -> PiecePolynomial:
        """The piece with derivatives by parameters seen from the first corner, instead of from a later one."""
        found = self.parameters
        for k in range(1, self.domain.corner_count):
            found = found.chosen(corner == k, self.parameters.after(self.domain.rotation(k).inverse()))
        return replace(self, parameters=found)

    @property
    def magnification(self) -> Any:
        """How many times as fast the piece's parameters run as those that were given: a power of two."""
        a, b, c, _ = self.parameters.jacobian
        return dr.maximum(dr.abs(a), dr.maximum(dr.abs(b), dr.abs(c)))

    def is_inside(self, tolerance: Any) -> Any:
        """Whether the parameters are in the piece, or no further outside than a tolerance."""
        return self.parameters.inside(self.domain) >= -tolerance

    def moved(self, du: Any, dv: Any) -> PiecePolynomial:
        """The same piece at other parameters, which may be outside."""
        a, b, c, d = self.parameters.jacobian
        u, v = self.parameters.u + (a * du + b * dv), self.parameters.v + (c * du + d * dv)
        return replace(self, parameters=MappedParameters(u, v, self.parameters.jacobian))

    def values(self, derivatives: int = 1) -> PatchValues:
        """Evaluate the piece at its parameters."""
        s, t = self.parameters.u - self.centre[0], self.parameters.v - self.centre[1]
        value, by_s, by_t, *second = self.polynomial.values(s, t, derivatives)
        constant = self.polynomial.coefficients[0]
        value = self.origin + dr.fma(value - constant, self.shrinking, constant)
        if self.basis is not None:
            first, first_s, first_t = self._first_term(s, t, value)
            value, by_s, by_t = value + first, by_s + first_s, by_t + first_t
        # The jacobian is a turn times the magnification. Without it, tangents keep their size at every level.
        size = self.magnification
        a, b, c, d = (each * dr.rcp(size) for each in self.parameters.jacobian)
        scale = size * self.shrinking
        du, dv = (by_s * a + by_t * c) * scale, (by_s * b + by_t * d) * scale
        if self.frame is not None:
            by_s, by_t = self.frame.tangents(s, t, by_s, by_t)
        tangent_u, tangent_v = by_s * a + by_t * c, by_s * b + by_t * d
        if second:
            ss, st, tt = (each * (scale * size) for each in second)
            second = [
                ss * (i * k) + st * (i * m + k * j) + tt * (j * m)
                for (i, j), (k, m) in (((a, c), (a, c)), ((a, c), (b, d)), ((b, d), (b, d)))
            ]
        return PatchValues(value, du, dv, tangent_u, tangent_v, tuple(second))

    def _first_term(self, s: Any, t: Any, value: Any) -> tuple[Any, Any, Any]:
        """What the first terms of (9) and (11) are more than those of (10) and (12), by rounding alone.

        The first eigenvector is one everywhere. So the term of the point is ``ĉ_1`` times the sum of the basis
        functions, which is one; those of the derivatives are ``2ⁿ⁺¹ ĉ_1`` times sums of their derivatives, which are
        zero. In single precision these sums are not quite, and the first term is not divided by ``λ_2ⁿ``.
        """
        one, by_s, by_t = (s * 0 for _ in range(3))
        for coefficients in zip(*(self.basis or ()), strict=True):
            of_one = Polynomial(tuple(s * 0 + each for each in coefficients), self.polynomial.powers).values(s, t, 1)
            one, by_s, by_t = one + of_one[0], by_s + of_one[1], by_t + of_one[2]
        over = dr.select(self.is_irregular, dr.rcp(self.shrinking), 0)
        return value * dr.select(self.is_irregular, one - 1, 0), value * (by_s * over), value * (by_t * over)

"""Regular patches as polynomials: in monomials, which kernels evaluate, and in Bernstein form, for bounds."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from math import factorial

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .equations import MOST_MULTIPLICATIONS

# Sums of Bernstein coefficients, differences and halvings have entries of small fractions; rounding leaves these.
NO_ENTRY = 1e-12


@dataclass(frozen=True, eq=False)
class BernsteinBasis:
    """Polynomials over a parameter domain by their Bernstein coefficients.

    Over the unit square products of polynomials in u and in v, over the unit triangle all up to a degree. The functions
    are non-negative and sum to one: a polynomial's values lie in the convex hull of its coefficients [Farin 2002].

    Parameters
    ----------
    degree : int
        In each of u and v over the square, of both together over the triangle.
    """

    domain: ParameterDomain
    degree: int

    @cached_property
    def indices(self) -> IntArray:
        """``(b, 2)`` position of each coefficient along u and v, in steps of ``1 / degree``."""
        return self.domain.indices(self.degree)

    @cached_property
    def _exponents(self) -> IntArray:
        """``(b, m)`` powers of the distances from the domain's edges that each function is a multiple of."""
        distances = self.domain.edge_distances(*(self.indices / self.degree).T)
        return np.rint(np.stack(distances, axis=1) * self.degree).astype(np.int64)

    def values(self, uv: FloatArray) -> FloatArray:
        """``(s, b)`` values of all functions at ``(s, 2)`` parameters."""
        factorials = np.array([factorial(count) for count in range(self.degree + 1)], dtype=np.float64)
        # The multinomial coefficient over the triangle, a product of two binomial ones over the square.
        found = factorials[-1] ** (self.domain.corner_count - 2) / factorials[self._exponents].prod(axis=1)
        for distance, exponent in zip(self.domain.edge_distances(*uv.T), self._exponents.T, strict=True):
            found = found * distance[:, None] ** exponent
        return found

    @cached_property
    def _sites(self) -> FloatArray:
        """``(b, 2)`` parameters at which values determine a polynomial: the places of the coefficients."""
        return self.indices / self.degree

    @cached_property
    def _from_values(self) -> FloatArray:
        return np.linalg.inv(self.values(self._sites))

    def coefficients(self, values_at_sites: FloatArray) -> FloatArray:
        """Coefficients ``(.., b, n)`` of the polynomials that have values ``(.., b, n)`` at ``indices / degree``."""
        return _clean(self._from_values @ values_at_sites)

    @cached_property
    def halves(self) -> FloatArray:
        """``(4, b, b)`` maps from coefficients to those over each copy of the domain, by de Casteljau's algorithm.

        In the order of `ParameterDomain.children`, by the parameters of these.
        """
        sites = [child.inverse()(self._sites) for child in self.domain.children]
        return self.coefficients(np.stack([self.values(at) for at in sites]))

    @cached_property
    def derivatives(self) -> FloatArray:
        """``(2, b, b)`` maps from coefficients to those of the derivatives by u and by v, in the same basis."""
        powers = self.indices
        lowered = [
            (powers[:, None] + step == powers).all(axis=2) * powers[:, axis] for axis, step in enumerate(np.eye(2))
        ]
        # All entries are integers: differences of neighbours, of one degree less, raised again.
        return np.rint(np.linalg.solve(self.monomials, np.stack(lowered) @ self.monomials))

    @cached_property
    def two_derivatives(self) -> FloatArray:
        """``(5, b, b)`` maps from coefficients to derivatives by u, v, uu, uv and vv, in the same basis."""
        u, v = self.derivatives
        return np.stack([u, v, u @ u, u @ v, v @ v])

    @cached_property
    def monomials(self) -> FloatArray:
        """``(b, b)`` map from coefficients to those of products of powers ``u^i v^j``, in the order of `indices`."""
        return np.linalg.solve((self._sites[:, None, :] ** self.indices).prod(axis=2), self.values(self._sites))

    @cached_property
    def sides(self) -> list[IntArray]:
        """Of each side of the domain the coefficients that are those of the curve along it."""
        return [np.flatnonzero(exponent == 0) for exponent in self._exponents.T]

    @cached_property
    def corners(self) -> IntArray:
        """``(m,)`` coefficients that are the values at the corners of the domain."""
        at = self.domain.corners * self.degree
        return np.array([int(np.flatnonzero((self.indices == corner).all(axis=1))[0]) for corner in at])


@dataclass(frozen=True, eq=False)
class RegularBernstein:
    """The regular patches of a scheme in Bernstein form."""

    basis: BernsteinBasis
    of_controls: FloatArray  # (b, R) float64: coefficients over a regular patch's control points
    of_monomials: FloatArray  # (b, m) float64: coefficients over those of the `PolynomialBasis`


@lru_cache(maxsize=16)
def regular_bernstein(scheme: Scheme) -> RegularBernstein:
    """Bernstein form of a scheme's regular patches.

    Raises SchemeError if these are no polynomials, see `polynomial_basis`.
    """
    polynomials = polynomial_basis(scheme)
    degree = int(scheme.domain.extent(polynomials.powers).max())
    basis = BernsteinBasis(scheme.domain, degree)
    of_monomials = basis.coefficients(polynomials.monomials(basis.indices / degree))
    return RegularBernstein(basis, _clean(of_monomials @ polynomials.matrix), of_monomials)


def times(rows: FloatArray, points: FloatArray) -> FloatArray:
    """``(r, 3, n)`` rows ``(r, b)`` times points ``(b, 3, n)``."""
    columns = points.reshape(len(points), -1)
    found = np.empty((len(rows), columns.shape[1]), dtype=np.result_type(rows, columns))
    length = max(1, MOST_MULTIPLICATIONS // max(1, rows.size))
    for begin in range(0, columns.shape[1], length):
        run = slice(begin, begin + length)
        np.matmul(rows, columns[:, run], out=found[:, run])
    return found.reshape(len(rows), *points.shape[1:])


def _clean(matrix: FloatArray) -> FloatArray:
    """The matrix with zeros in place of rounding errors."""
    return np.where(np.abs(matrix) < NO_ENTRY, 0, matrix)


# Powers of each parameter that a basis may have. Those of this package have 2 (Doo-Sabin), 3 or 4 in all (Loop).
HIGHEST_POWER = 5
# Coefficients of powers that occur are fractions of small numbers. Below this are those that rounding leaves of others.
NO_COEFFICIENT = 1e-6
# Monomials are independent: their least singular value is 10^-7 of the largest. NumPy's own limit is not used, as NumPy
# 2.2 looks up the machine's numbers for it, and warns in threads of Mitsuba's, which flush the smallest ones to zero.
INDEPENDENT = 1e-13
# Tolerance of a polynomial's difference from the scheme's own basis, for rounding.
ROUNDED = 1e-11


@dataclass(frozen=True, eq=False)
class PolynomialBasis:
    """A scheme's regular basis, as polynomials about the middle of the domain.

    Powers of distances from the middle are small, so that single precision loses no more digits than in the scheme's
    own formulas.
    """

    centre: FloatArray  # (2,) float64: middle of the domain, ``(u_0, v_0)``
    powers: IntArray  # (m, 2) int64: of the monomials ``(u - u_0)^a (v - v_0)^b``: a and b. The first is the constant.
    matrix: FloatArray  # (m, R) float64: coefficients of each basis function, in columns

    def monomials(self, uv: FloatArray) -> FloatArray:
        """``(s, m)`` values at ``(s, 2)`` parameters."""
        return monomial_values(self.powers, uv - self.centre)[0].T


def monomial_values(powers: IntArray, st: FloatArray) -> FloatArray:
    """``(3, m, s)`` values of monomials and their two derivatives, at parameters ``(s, 2)`` from the middle.

    Parameters come last: NumPy's loops are then long.
    """
    (a, b), (s, t) = powers.T, st.T
    power_s, power_t = (np.vander(each, int(powers.max()) + 1, increasing=True).T for each in (s, t))
    along_s, along_t = power_s[a], power_t[b]
    # The factors of derivatives that vanish are zero, whatever the power.
    return np.stack([along_s * along_t, a[:, None] * power_s[a - 1] * along_t, b[:, None] * along_s * power_t[b - 1]])


@lru_cache(maxsize=16)
def polynomial_basis(scheme: Scheme) -> PolynomialBasis:
    """Find the polynomials that are equal to a scheme's `regular_basis`.

    Raises SchemeError if there are none: the basis consists of several pieces, or is of too high a degree.
    """
    centre = scheme.domain.centre
    along = np.linspace(0, 1, 2 * HIGHEST_POWER + 3)
    uv = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    uv = uv[scheme.domain.inside(uv) >= 0]
    powers: IntArray = np.indices((HIGHEST_POWER + 1,) * 2).reshape(2, -1).T
    wanted = scheme.regular_basis(uv, 1)[0]
    every = PolynomialBasis(centre, powers, np.empty((len(powers), wanted.shape[1])))
    matrix, *_ = np.linalg.lstsq(every.monomials(uv), wanted, rcond=INDEPENDENT)
    powers = powers[np.abs(matrix).max(axis=1) > NO_COEFFICIENT]
    # Again, as the powers that do not occur have taken some digits.
    values = replace(every, powers=powers).monomials(uv)
    found = PolynomialBasis(centre, powers, np.linalg.lstsq(values, wanted, rcond=INDEPENDENT)[0])
    error = np.abs(values @ found.matrix - wanted).max()
    if error > ROUNDED or found.powers[0].any():
        raise SchemeError(
            f"{scheme.name}: the regular basis is {error:.1e} from polynomials of degree {HIGHEST_POWER}; expected one "
            "that is polynomial over the whole domain, for evaluation at any parameters in kernels"
        )
    return found

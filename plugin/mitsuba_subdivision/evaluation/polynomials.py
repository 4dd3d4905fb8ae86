"""Regular patches as polynomials: monomials for evaluation in kernels, Bernstein form for bounds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import factorial

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray, ParameterDomain
from ..schemes.scheme import Scheme, SchemeError
from .equations import times_matrix

# Largest rounding error in the matrices of `BernsteinBasis`, whose entries are fractions with small denominators.
NO_ENTRY = 1e-12
# Highest power of each parameter that a basis may have. The schemes of this package need 2 (Doo-Sabin), 3
# (Catmull-Clark) and 4 (Loop, total degree).
HIGHEST_POWER = 5
# Largest rounding error in the coefficients of monomials. Other coefficients are fractions with small denominators.
NO_COEFFICIENT = 1e-6
# Cutoff of singular values for least squares, relative to the largest. The monomials are independent: their smallest
# singular value is 10^-7 of the largest. NumPy's default is not used, as NumPy 2.2 computes it from `numpy.finfo`,
# which warns in Mitsuba's threads because they flush denormal numbers to zero.
INDEPENDENT = 1e-13
ROUNDED = 1e-11  # Tolerance when comparing the polynomials with the scheme's `regular_basis`


@dataclass(frozen=True, eq=False)
class BernsteinBasis:
    """Bernstein basis of the polynomials over a parameter domain [Farin 2002].

    A tensor product over the unit square, and the basis of the total degree over the unit triangle. A polynomial's
    values lie in the convex hull of its coefficients.
    """

    domain: ParameterDomain
    degree: int  # In each of u and v over the square, total degree over the triangle

    @cached_property
    def indices(self) -> IntArray:
        """``(b, 2)`` position of each coefficient along u and v, in steps of ``1 / degree``."""
        return self.domain.indices(self.degree)

    @cached_property
    def _exponents(self) -> IntArray:
        """``(b, m)`` exponents of the distances from the domain's edges in each basis function."""
        distances = self.domain.edge_distances(*(self.indices / self.degree).T)
        return np.rint(np.stack(distances, axis=1) * self.degree).astype(np.int64)

    def values(self, uv: FloatArray) -> FloatArray:
        """Return ``(s, b)`` values of all basis functions at ``(s, 2)`` parameters."""
        factorials = np.array([factorial(count) for count in range(self.degree + 1)], dtype=np.float64)
        # A multinomial coefficient over the triangle, a product of two binomial coefficients over the square.
        values = factorials[-1] ** (self.domain.corner_count - 2) / factorials[self._exponents].prod(axis=1)
        for distance, exponent in zip(self.domain.edge_distances(*uv.T), self._exponents.T, strict=True):
            values = values * np.vander(distance, self.degree + 1, increasing=True)[:, exponent]
        return values

    @cached_property
    def _sites(self) -> FloatArray:
        """``(b, 2)`` parameters of the coefficients; the values there determine a polynomial."""
        return self.indices / self.degree

    @cached_property
    def _from_values(self) -> FloatArray:
        return np.linalg.inv(self.values(self._sites))

    def coefficients(self, values_at_sites: FloatArray) -> FloatArray:
        """Return ``(.., b, n)`` coefficients of the polynomials with values ``(.., b, n)`` at ``indices / degree``."""
        return self._from_values @ values_at_sites

    @cached_property
    def halves(self) -> FloatArray:
        """``(4, b, b)`` maps from coefficients to those over each of `ParameterDomain.children`."""
        sites = [child.inverse()(self._sites) for child in self.domain.children]
        return _clean(self.coefficients(np.stack([self.values(child_sites) for child_sites in sites])))

    @cached_property
    def derivatives(self) -> FloatArray:
        """``(2, b, b)`` maps from coefficients to those of the derivatives by u and by v, in the same basis."""
        # Values and derivatives of the monomials at the sites.
        values, *slopes = monomial_values(self.indices, self._sites).swapaxes(1, 2)
        of_monomials = np.linalg.solve(values, self.values(self._sites))
        # All entries are integers: differences of neighbours, degree-elevated by one.
        return np.rint(self._from_values @ np.stack(slopes) @ of_monomials)

    @cached_property
    def two_derivatives(self) -> FloatArray:
        """``(5, b, b)`` maps from coefficients to derivatives by u, v, uu, uv and vv, in the same basis."""
        u, v = self.derivatives
        return np.stack([u, v, u @ u, u @ v, v @ v])

    @cached_property
    def jets(self) -> FloatArray:
        """``(b, 6 b)`` map from values of the basis functions to their values and `two_derivatives`, side by side."""
        return np.concatenate([np.eye(len(self.indices)), *self.two_derivatives], axis=1)

    @cached_property
    def sides(self) -> list[IntArray]:
        """For each side of the domain, indices of the Bernstein coefficients of the curve along it."""
        return [np.flatnonzero(exponent == 0) for exponent in self._exponents.T]

    @cached_property
    def corners(self) -> IntArray:
        """``(m,)`` indices of the coefficients at the corners of the domain."""
        corners = self.domain.corners * self.degree
        return np.array([int(np.flatnonzero((self.indices == corner).all(axis=1))[0]) for corner in corners])


def times(rows: FloatArray, points: FloatArray) -> FloatArray:
    """Multiply rows ``(r, b)`` by points ``(b, 3, n)``, by `times_matrix`; return ``(r, 3, n)``."""
    columns = points.reshape(len(points), -1)
    product = np.empty((len(rows), columns.shape[1]), dtype=np.result_type(rows, columns))
    times_matrix(columns.T[None], rows.T, product.T[None])
    return product.reshape(len(rows), *points.shape[1:])


def _clean(matrix: FloatArray) -> FloatArray:
    """Replace rounding errors of a matrix, whose entries are fractions of small integers, by zeros."""
    return np.where(np.abs(matrix) < NO_ENTRY, 0, matrix)


@dataclass(frozen=True, eq=False)
class PolynomialBasis:
    """The regular basis of a scheme as polynomials about the middle of the domain, where powers stay small."""

    domain: ParameterDomain
    # (m, 2) int64: a and b of the monomials ``(u - u_0)^a (v - v_0)^b`` about the middle. The first is the constant.
    powers: IntArray
    matrix: FloatArray  # (m, R) float64: coefficients of the basis functions, in columns

    @cached_property
    def bernstein(self) -> BernsteinBasis:
        """Bernstein basis of these polynomials."""
        return BernsteinBasis(self.domain, int(self.domain.extent(self.powers).max()))

    @cached_property
    def of_controls(self) -> FloatArray:
        """``(b, R)`` float64: Bernstein coefficients over a regular patch's control points."""
        sites = self.bernstein.indices / self.bernstein.degree
        of_monomials = self.bernstein.coefficients(monomial_values(self.powers, sites - self.domain.centre)[0].T)
        return _clean(_clean(of_monomials) @ self.matrix)


def monomial_values(powers: IntArray, st: FloatArray) -> FloatArray:
    """Return ``(3, m, s)`` values and derivatives of monomials at ``(s, 2)`` parameters from the middle."""
    (a, b), (s, t) = powers.T, st.T
    power_s, power_t = (np.vander(x, int(powers.max()) + 1, increasing=True).T for x in (s, t))
    along_s, along_t = power_s[a], power_t[b]
    # Where `a - 1` is negative it indexes another power, but the factor `a` is zero.
    return np.stack([along_s * along_t, a[:, None] * power_s[a - 1] * along_t, b[:, None] * along_s * power_t[b - 1]])


@lru_cache(maxsize=16)
def polynomial_basis(scheme: Scheme) -> PolynomialBasis:
    """Return the polynomials that equal a scheme's `regular_basis`.

    Raises SchemeError if there are none: the basis is piecewise, or its degree is too high.
    """
    along = np.linspace(0, 1, 2 * HIGHEST_POWER + 3)
    uv = np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
    uv = uv[scheme.domain.inside(uv) >= 0]
    powers: IntArray = np.indices((HIGHEST_POWER + 1,) * 2).reshape(2, -1).T
    basis_values = scheme.regular_basis(uv, 1)[0]
    monomials = monomial_values(powers, uv - scheme.domain.centre)[0].T
    matrix, *_ = np.linalg.lstsq(monomials, basis_values, rcond=INDEPENDENT)
    occurs = np.abs(matrix).max(axis=1) > NO_COEFFICIENT
    # Solve again without the powers that do not occur, which is more accurate.
    powers, values = powers[occurs], monomials[:, occurs]
    basis = PolynomialBasis(scheme.domain, powers, np.linalg.lstsq(values, basis_values, rcond=INDEPENDENT)[0])
    error = np.abs(values @ basis.matrix - basis_values).max()
    if error > ROUNDED or basis.powers[0].any():
        raise SchemeError(
            f"{scheme.name}: the regular basis is {error:.1e} from polynomials of degree {HIGHEST_POWER}; expected one "
            "that is polynomial over the whole domain, for evaluation at any parameters in kernels"
        )
    return basis

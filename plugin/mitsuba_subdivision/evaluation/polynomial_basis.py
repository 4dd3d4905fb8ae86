"""The basis of a scheme's regular patches as polynomials, for kernels that evaluate a patch at any parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from ..mesh.connectivity import IntArray
from ..schemes.domain import FloatArray
from ..schemes.scheme import Scheme, SchemeError

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

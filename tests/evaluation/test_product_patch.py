"""The weights of regular patches as products of one-dimensional ones."""

import numpy as np
import pytest
from mitsuba_subdivision.evaluation.element import element_stencils
from mitsuba_subdivision.evaluation.patch_pieces import regular_signature
from mitsuba_subdivision.evaluation.product_patch import product_patch
from mitsuba_subdivision.mesh.signature import Signature, TaggedFan
from mitsuba_subdivision.schemes import CatmullClark, DooSabin, Loop

pytestmark = pytest.mark.core

# Sums of products of two B-spline weights.
ROUNDING = 1e-15
PRODUCTS = pytest.mark.parametrize("scheme", [CatmullClark(), DooSabin()], ids=lambda scheme: scheme.name)


@PRODUCTS
@pytest.mark.parametrize("corner", range(4))
def test_products_are_the_stencils_from_every_corner(scheme, corner, np_rng):
    signature = regular_signature(scheme)
    patch = product_patch(scheme, signature)
    uv = np_rng.random((50, 2))
    stencils = element_stencils(scheme, signature, scheme.domain.rotation(corner)(uv))
    (along_u, along_u_slope), (along_v, along_v_slope) = (patch.line_weights(t) for t in uv.T)
    point, du, dv = (
        np.einsum("sj,si->sji", v, u)
        for v, u in ((along_v, along_u), (along_v, along_u_slope), (along_v_slope, along_u))
    )
    places = patch.lattice_index[corner]
    np.testing.assert_allclose(point, stencils[0][:, places], rtol=0, atol=ROUNDING)
    # Seen from another corner, tangents are turned; the normal is their cross product, for each pair of weights.
    found = crossed(du.reshape(50, -1), dv.reshape(50, -1))
    expected = crossed(*stencils[1:, :, places.ravel()])
    np.testing.assert_allclose(found, expected, rtol=0, atol=4 * ROUNDING)


def crossed(du, dv):
    products = du[:, :, None] * dv[:, None, :]
    return products - products.transpose(0, 2, 1)


@PRODUCTS
def test_one_dimensional_weights_sum_to_one_and_their_slopes_to_zero(scheme, np_rng):
    values, slopes = product_patch(scheme, regular_signature(scheme)).line_weights(np_rng.random(20))
    np.testing.assert_allclose(values.sum(axis=1), 1, rtol=0, atol=ROUNDING)
    np.testing.assert_allclose(slopes.sum(axis=1), 0, rtol=0, atol=ROUNDING)


def test_other_patches_are_no_products():
    scheme, fan = CatmullClark(), (4,) * 4
    assert product_patch(Loop(), regular_signature(Loop())) is None
    assert product_patch(scheme, Signature("face", ((4,) * 5, fan, fan, fan))) is None
    border = TaggedFan((4, 4), ()), TaggedFan((4,), (4,))
    assert product_patch(scheme, Signature("face", (*border, fan, fan))) is None


class NoProduct(CatmullClark):
    """Its basis is that of another patch, turned: still a sum of one, but no product."""

    def regular_basis(self, uv, derivatives):
        turned = super().regular_basis(uv[:, ::-1], derivatives)
        return (super().regular_basis(uv, derivatives) + turned) / 2


def test_a_basis_that_is_no_product_is_recognised():
    assert product_patch(NoProduct(), regular_signature(NoProduct())) is None


def lattice(count):
    along = np.linspace(0, 1, count)
    return np.stack(np.meshgrid(along, along), axis=-1)


SQUARE = lattice(6)
ORDERS = {
    "first side": SQUARE[0],
    "second side": SQUARE[:, -1],
    "third side": SQUARE[-1, ::-1],
    "fourth side": SQUARE[::-1, 0],
    "inside": SQUARE[1:-1, 1:-1],
    "turned": np.rot90(SQUARE)[1:-1, 1:-1],
    "oblong": np.rot90(SQUARE[1:3], 3),
    "corner": SQUARE[:1, :1],
}


@pytest.mark.parametrize("order", ORDERS)
def test_rows_are_the_samples(order):
    scheme, uv = CatmullClark(), ORDERS[order].reshape(-1, 2)
    rows = product_patch(scheme, regular_signature(scheme)).rows(uv)
    found = np.stack(np.meshgrid(rows.u, rows.v), axis=-1).reshape(-1, 2)
    np.testing.assert_allclose(scheme.domain.rotation(rows.corner)(found), uv, rtol=0, atol=ROUNDING)
    assert len(rows.u) == ORDERS[order].shape[-2]


def test_samples_in_no_order_are_an_error():
    patch = product_patch(CatmullClark(), regular_signature(CatmullClark()))
    with pytest.raises(ValueError, match="no rows of a lattice"):
        patch.rows(np.array([[0.1, 0.2], [0.3, 0.2], [0.5, 0.7]]))

"""The boundary of a medium and the albedo of a thick slab: closed forms, inverted."""

import numpy as np
import pytest
from media import IORS

from ginn_jax import slab
from ginn_jax.slab import external_reflectance, single_scattering_albedo, slab_albedo


def internal_reflectance(ior):
    """Share of diffuse light inside that the boundary reflects, totally or not."""
    _, share, mirrored = slab._inner_directions(ior)
    return float(share @ mirrored)


@pytest.mark.parametrize("ior", [1.0, 1.0001, 1.3, 1.5, 2.0])
def test_inside_and_outside_reflectance_are_reciprocal(ior):
    entering = 1 - external_reflectance(ior)
    assert ior**2 * (1 - internal_reflectance(ior)) == pytest.approx(entering, rel=1e-7)


def test_reflectance_of_glass():
    """Walsh's closed form of the diffuse reflectance gives .0918 at 1.5."""
    assert external_reflectance(1.5) == pytest.approx(0.0918, abs=5e-5)
    for reflectance in (external_reflectance(1.0), internal_reflectance(1.0)):
        assert reflectance == pytest.approx(0, abs=1e-20)


def test_slab_albedo_of_an_index_matched_half_space():
    """First order in albedo, by hand: alpha (1 - ln 2) 2 / 3; and nothing is lost."""
    single = 2 / 3 * (1 - np.log(2))
    assert slab_albedo(1e-6, 1.0) == pytest.approx(1e-6 * single, rel=1e-5)
    for ior in IORS:
        assert slab_albedo(1.0, ior) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("ior", [*IORS, 2.0])
def test_albedo_is_inverted(ior):
    albedo = np.array([0, 1e-4, 0.1, 0.5, 0.9, 0.999, 1])
    alpha = single_scattering_albedo(albedo, ior)
    assert alpha[0] == 0
    assert alpha[-1] == 1
    assert (np.diff(alpha) > 0).all()
    again = [slab_albedo(a, ior) for a in alpha]
    np.testing.assert_allclose(again, albedo, rtol=1e-7, atol=2e-6)

"""Rays and paths that share out what they draw: the same light, with less error."""

import numpy as np
import pytest
from media import BALL, medium_of, scene_of, surface
from rooms import WHITE, copies, cup, floor_and_wall, sampled

from ginn_jax import draws, estimates, reference
from ginn_jax.errors import InputError
from ginn_jax.irradiance import indirect_irradiance, light_scene
from ginn_jax.lighting import constant_sky, studio
from ginn_jax.renderer import use_mitsuba
from ginn_jax.subsurface import subsurface_exitance


def drawn(points, rays, seed=3):
    """Both numbers in [0, 1) of every ray of every point."""
    mi, variant = use_mitsuba()
    import drjit as dr

    with mi.variant_context(variant):
        lane = dr.arange(mi.UInt32, points * rays)
        words = draws.stratified_pair(rays)(lane // rays, lane % rays, mi.UInt32(seed))
        return [w.numpy().reshape(points, rays) / 2**32 for w in words]


@pytest.mark.parametrize("rays", [1, 7, 16, 64])
def test_rays_of_a_point_share_out_both_axes(rays):
    a, b = (np.sort(x, axis=1) for x in drawn(200, rays))
    gaps = np.diff(a, axis=1, append=a[:, :1] + 1)
    np.testing.assert_allclose(gaps, 1 / rays, atol=1e-6)
    # Of digits that are turned round every whole power of two is shared out.
    parts = 2 ** int(np.log2(rays))
    held = (np.floor(b * parts)[..., None] == np.arange(parts)).any(axis=1)
    assert held.all()


@pytest.mark.parametrize("ray", [0, 3, 6])
def test_each_ray_by_itself_is_uniform(ray):
    a, b = (x[:, ray] for x in drawn(40_000, 7))
    counts, _, _ = np.histogram2d(a, b, bins=10, range=[[0, 1], [0, 1]])
    expected = 40_000 / 100
    assert ((counts - expected) ** 2 / expected).sum() < 99 + 5 * np.sqrt(2 * 99)


def ends():
    """Functions of the seed and of whether to stratify, with 16 rays or paths a point:
    openness before a wall, light in a cup, light through a ball."""
    wall = reference.build_scene(floor_and_wall(1))
    dark = light_scene(cup(), WHITE * 0.8, constant_sky())
    ball, medium = scene_of(BALL, studio(1)), medium_of(0.8, 5.0, 1.3)
    return {
        "ao": lambda **how: reference.ambient_occlusion(
            wall, *copies((-0.02, 0, 0), 2000), 0.1, rays=16, **how
        ),
        "gi": lambda **how: indirect_irradiance(
            dark, *sampled(cup(), 300), paths=16, **how
        ),
        "sss": lambda **how: subsurface_exitance(
            ball, medium, *surface(BALL, 300), paths=16, **how
        )[0],
    }


@pytest.mark.parametrize(("effect", "gain"), [("ao", 3), ("gi", 1.2), ("sss", 1.2)])
def test_the_mean_is_the_same_and_varies_less(effect, gain):
    cast = ends()[effect]
    found = {
        how: np.array([cast(stratified=how, seed=s).mean for s in range(24)], float)
        for how in (False, True)
    }
    one, other = (f.reshape(24, -1).mean(axis=1) for f in found.values())
    sigma = np.hypot(one.std(ddof=1), other.std(ddof=1)) / np.sqrt(24)
    assert abs(one.mean() - other.mean()) < 5 * sigma
    assert sigma < 0.02 * one.mean()
    variance = {how: f.var(axis=0, ddof=1).mean() for how, f in found.items()}
    assert variance[True] * gain < variance[False]


@pytest.mark.parametrize("effect", ["ao", "gi", "sss"])
def test_variance_is_not_known(effect):
    cast = ends()[effect]
    assert np.isnan(cast(stratified=True, seed=0).variance).all()
    assert np.isfinite(cast(stratified=False, seed=0).variance).all()


def test_seed_decides_and_chunks_do_not(monkeypatch):
    cast = ends()["ao"]
    whole = cast(stratified=True, seed=1).mean
    assert (whole != cast(stratified=True, seed=2).mean).any()
    monkeypatch.setattr(reference, "RAYS_PER_LAUNCH", 5000)
    np.testing.assert_array_equal(whole, cast(stratified=True, seed=1).mean)


@pytest.mark.parametrize("paths", [1, 2, 6, 12, 16, 30, 1024])
def test_so_many_have_strata(paths):
    estimates.check_stratified(paths)
    mi, variant = use_mitsuba()
    with mi.variant_context(variant):
        sampler = estimates.sampler_of(2, paths, 0, 0, True)
        assert sampler.sample_count() == paths


@pytest.mark.parametrize(("paths", "others"), [(5, "4 or 6"), (32, "30 or 35")])
def test_others_are_refused(paths, others):
    dark = light_scene(cup(), WHITE, studio(1))
    with pytest.raises(
        InputError, match=f"{paths} paths have no strata: give {others}"
    ):
        indirect_irradiance(
            dark, *sampled(cup(), 3), paths=paths, stratified=True, seed=0
        )

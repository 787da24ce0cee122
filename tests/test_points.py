"""Samples of surfaces, and point clouds."""

import warnings

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scans import write_points
from triangles import COORDINATE, CORNERS, clear_cut, cube, heron, soup

from ginn_jax import mesh as gm
from ginn_jax import samples as gs


@given(CORNERS, st.integers(0, 2**32))
def test_samples_lie_on_their_triangles(corners, seed):
    corners = clear_cut(corners)
    assume(len(corners))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # The material tells which triangle a sample is from.
        mesh = gm.make_mesh(*soup(corners), np.arange(len(corners)))
    samples = gs.sample_surface(mesh, 64, seed=seed)
    a, b, c = np.moveaxis(
        mesh.vertices[mesh.faces].astype(float)[samples.material], 1, 0
    )
    basis = np.stack([b - a, c - a, samples.normal], -1)
    u, v, w = np.linalg.solve(basis, (samples.position - a)[..., None])[..., 0].T
    assert np.abs(w).max() < 1e-4
    assert min(u.min(), v.min(), (1 - u - v).min()) > -1e-3
    np.testing.assert_allclose(np.linalg.norm(samples.normal, axis=1), 1, atol=1e-5)
    for edge in (b - a, c - a):
        assert np.abs((samples.normal * edge).sum(-1)).max() < 1e-4
    assert (np.linalg.det(basis) > 0).all()
    same = gs.sample_surface(mesh, 64, seed=seed)
    np.testing.assert_array_equal(samples.position, same.position)


@settings(max_examples=20)
@given(CORNERS)
def test_samples_are_uniform_by_area(corners):
    corners = clear_cut(corners)
    assume(len(corners))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = gm.make_mesh(*soup(corners), np.arange(len(corners)))
    count, share = 20_000, heron(corners) / heron(corners).sum()
    samples = gs.sample_surface(mesh, count, seed=7)
    found = np.bincount(samples.material, minlength=len(corners))
    deviation = np.sqrt(count * share * (1 - share))
    assert (np.abs(found - count * share) <= 6 * deviation + 1).all()
    middle = mesh.vertices[mesh.faces].astype(float).mean(1)[samples.material]
    spread = np.ptp(corners)
    assert np.abs((samples.position - middle).mean(0)).max() < 6 * spread / count**0.5


def test_ground_samples_match_the_density_of_the_cloud():
    mesh = gm.make_mesh(*cube())
    cloud = gs.sample_surface(mesh, 6000, seed=1)  # 1000 a unit of area
    both = gs.add_ground_samples(cloud, 0.8, seed=2)
    ground = both.position[both.material == 1]
    assert len(ground) == pytest.approx(1000 * 1.6**2, rel=0.2)
    np.testing.assert_array_equal(
        both.normal[both.material == 1], [[0, 1, 0]] * len(ground)
    )
    np.testing.assert_allclose(ground[:, 1], -0.5, atol=1e-3)
    assert 0.75 < np.abs(ground[:, [0, 2]]).max() <= 0.8


@settings(max_examples=25)
@given(
    hnp.arrays(
        np.float32, st.tuples(st.integers(2, 9), st.just(6)), elements=COORDINATE
    )
)
def test_point_clouds_load_with_unit_normals(tmp_path_factory, rows):
    assume((np.linalg.norm(rows[:, 3:].astype(float), axis=1) > 1e-3).all())
    path = write_points(tmp_path_factory.mktemp("points") / "cloud.ply", rows)
    samples = gs.load_points(path)
    np.testing.assert_allclose(samples.position, rows[:, :3], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(samples.normal, axis=1), 1, atol=1e-5)
    assert ((samples.normal * rows[:, 3:]).sum(1) > 0).all()
    np.testing.assert_allclose(np.cross(samples.normal, rows[:, 3:]), 0, atol=1e-4)
    np.testing.assert_array_equal(samples.material, 0)

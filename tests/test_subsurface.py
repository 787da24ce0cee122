"""Conserved energy, closed forms and Mitsuba's own volumetric paths."""

import numpy as np
import pytest
import trimesh
from jaxtyping import TypeCheckError

from ginn_jax import irradiance, subsurface
from ginn_jax.errors import InputError
from ginn_jax.irradiance import direct_irradiance, light_scene
from ginn_jax.lighting import EnvironmentMap, PointLight, constant_sky, studio
from ginn_jax.mesh import Mesh
from ginn_jax.renderer import use_mitsuba
from ginn_jax.slab import (
    external_reflectance,
    internal_reflectance,
    single_scattering_albedo,
    slab_albedo,
)
from ginn_jax.subsurface import Medium, subsurface_exitance

BALL = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
SLAB = trimesh.creation.box((1, 1, 0.1))
IORS = [1.0, 1.3, 1.5]


def scene_of(shape, light, opaque=None):
    """The shape as material 0 and what stands beside it as material 1."""
    parts = [shape] if opaque is None else [shape, opaque]
    material = [np.full(len(p.faces), i, np.int32) for i, p in enumerate(parts)]
    both = trimesh.util.concatenate(parts)
    mesh = Mesh(
        both.vertices.astype(np.float32),
        both.faces.astype(np.int32),
        np.concatenate(material),
    )
    return light_scene(mesh, np.full((2, 3), 0.5), light)


def medium_of(albedo, extinction, ior):
    albedo = np.broadcast_to(np.float32(albedo), 3)
    return Medium(np.ascontiguousarray(albedo), extinction, ior)


def surface(shape, count, seed=0):
    points, faces = trimesh.sample.sample_surface(shape, count, seed=seed)
    normals = shape.face_normals[faces]
    return points.astype(np.float32), normals.astype(np.float32)


def middle(z, count):
    """`count` times the centre of the face of `SLAB` at height z."""
    points = np.tile(np.array([0, 0, z], np.float32), (count, 1))
    return points, points / abs(z)


def total(estimate):
    """The mean over all points, and its standard deviation."""
    mean = estimate.mean.astype(float).mean(0)
    return mean, np.sqrt(estimate.variance.astype(float).sum(0)) / len(estimate.mean)


# The boundary and the albedo


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


@pytest.mark.parametrize("ior", IORS)
def test_thick_slab_has_the_albedo_asked_for(ior):
    """1,000 mean free paths a side: the centre of a face does not see the edges."""
    block = trimesh.creation.box((1, 1, 1))
    albedo = np.array([0.1, 0.5, 0.9], np.float32)
    points, normals = middle(0.5, 64)
    result, _ = subsurface_exitance(
        scene_of(block, constant_sky()),
        Medium(albedo, 1000.0, ior),
        points,
        normals,
        paths=1024,
        seed=0,
    )
    mean, sigma = total(result)
    expected = (1 - external_reflectance(ior)) * albedo * np.pi
    assert (np.abs(mean - expected) < 4 * sigma).all()
    assert (sigma < [0.02 * x for x in expected]).all()


# Energy


@pytest.mark.parametrize("ior", IORS)
@pytest.mark.parametrize("extinction", [0.0, 0.1, 5.0, 50.0])
def test_medium_without_absorption_returns_what_enters(extinction, ior):
    points, normals = surface(BALL, 64)
    result, lost = subsurface_exitance(
        scene_of(BALL, constant_sky(2.0)),
        medium_of(1, extinction, ior),
        points,
        normals,
        paths=2048,
        seed=1,
    )
    mean, sigma = total(result)
    expected = 2 * np.pi * (1 - external_reflectance(ior))
    assert (np.abs(mean - expected) < 4 * sigma).all()
    assert (sigma < 0.005 * expected).all()
    assert lost < 1e-4


def test_flux_out_is_flux_in_under_uneven_light():
    """A point light beside the ball: exitance moves elsewhere, its total does not."""
    points, normals = surface(BALL, 20_000)
    light = PointLight(np.array([0.0, 0.3, 1.0]), np.array([1.0, 2.0, 4.0]))
    scene = scene_of(BALL, light)
    result, _ = subsurface_exitance(
        scene, medium_of(1, 10.0, 1.3), points, normals, paths=8, seed=2
    )
    arrives = direct_irradiance(scene, points, normals, samples=1, seed=0)
    enters = (1 - external_reflectance(1.3)) * arrives.astype(float)
    difference = result.mean - enters
    sigma = difference.std(0) / np.sqrt(len(points))
    assert (np.abs(difference.mean(0)) < 4 * sigma).all()
    assert (sigma < 0.02 * enters.mean(0)).all()
    assert (np.abs(difference).mean(0) > 0.2 * enters.mean(0)).all()


def test_black_medium_is_black():
    points, normals = surface(BALL, 64)
    result, _ = subsurface_exitance(
        scene_of(BALL, constant_sky()),
        medium_of(0, 50.0, 1.3),
        points,
        normals,
        paths=256,
        seed=3,
    )
    assert result.mean.mean() < 0.01


def test_twice_the_light_gives_exactly_twice_the_exitance():
    points, normals = surface(BALL, 50)
    light = studio(1)
    medium = medium_of((0.3, 0.6, 0.9), 20.0, 1.3)
    one, two = (
        subsurface_exitance(
            scene_of(BALL, EnvironmentMap(light.radiance * np.float32(factor))),
            medium,
            points,
            normals,
            paths=64,
            seed=4,
        )[0]
        for factor in (1, 2)
    )
    assert one.mean.min() > 0
    np.testing.assert_array_equal(two.mean, 2 * one.mean)


# Mitsuba


def volpath_exitance(shape, medium, points, normals, paths):
    """The same under a sky of radiance 1, by Mitsuba's `volpath` and `dielectric`."""
    mi, variant = use_mitsuba()
    import drjit as dr

    with mi.variant_context(variant):
        alpha = single_scattering_albedo(medium.albedo, medium.ior)
        parts = mi.Properties()
        parts["boundary"] = mi.load_dict(
            {"type": "dielectric", "int_ior": medium.ior, "ext_ior": 1.0}
        )
        parts["interior"] = mi.load_dict(
            {
                "type": "homogeneous",
                "albedo": {"type": "rgb", "value": alpha.tolist()},
                "sigma_t": medium.extinction,
                "sample_emitters": False,
            }
        )
        solid = mi.Mesh("solid", len(shape.vertices), len(shape.faces), parts)
        params = mi.traverse(solid)
        params["vertex_positions"] = shape.vertices.astype(np.float32).ravel()
        params["faces"] = shape.faces.astype(np.uint32).ravel()
        params.update()
        sky = {"type": "constant"}
        scene = mi.load_dict({"type": "scene", "solid": solid, "sky": sky})
        start = np.repeat(points - 1e-5 * normals, paths, axis=0).T
        inward = np.ascontiguousarray(np.repeat(-normals, paths, axis=0).T)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, start.shape[1])
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        toward = mi.Frame3f(mi.Normal3f(inward)).to_world(local)
        cast = mi.Ray3f(mi.Point3f(np.ascontiguousarray(start)), toward)
        leaves = 1 - mi.fresnel(local.z, mi.Float(1 / medium.ior))[0]
        integrator = mi.load_dict({"type": "volpath", "rr_depth": 1000})
        inside = scene.shapes()[0].interior_medium()
        radiance, _, _ = integrator.sample(
            scene, sampler, mi.RayDifferential3f(cast), inside, leaves > 0
        )
        values = np.pi * leaves * radiance
        dr.eval(values)
        return irradiance.summarize(values, paths)


@pytest.mark.parametrize("shape", [BALL, SLAB], ids=["ball", "slab"])
def test_mitsubas_volumetric_paths_agree(shape):
    """Under a constant sky it matters not that only irradiance enters."""
    medium = medium_of((0.1, 0.5, 0.9), 5.0, 1.3)
    points, normals = surface(shape, 64)
    theirs, their_sigma = total(volpath_exitance(shape, medium, points, normals, 2048))
    result, _ = subsurface_exitance(
        scene_of(shape, constant_sky()), medium, points, normals, paths=4096, seed=5
    )
    ours, sigma = total(result)
    sigma = np.hypot(sigma, their_sigma)
    assert (np.abs(ours - theirs) < 4 * sigma).all()
    assert (sigma < 0.01 * theirs).all()


# Light from one side


def test_thin_slab_glows_in_front_when_lit_from_behind():
    lamp = PointLight(np.array([0.0, 0.0, 2.0]), np.array([1.0, 1.0, 1.0]))
    points, normals = middle(-0.05, 64)
    scene = scene_of(SLAB, lamp)
    medium = medium_of((0.2, 0.5, 0.9), 30.0, 1.3)
    assert not direct_irradiance(scene, points, normals, samples=1, seed=0).any()
    front, _ = subsurface_exitance(scene, medium, points, normals, paths=512, seed=6)
    mean, sigma = total(front)
    assert (mean > 5 * sigma).all()
    assert (np.diff(mean) > 0).all()
    behind, _ = subsurface_exitance(scene, medium, *middle(0.05, 64), paths=512, seed=6)
    assert (total(behind)[0] > mean).all()


def test_what_stands_before_the_light_takes_it():
    lamp = PointLight(np.array([0.0, 0.0, 2.0]), np.array([1.0, 1.0, 1.0]))
    screen = trimesh.creation.box((9, 9, 0.1))
    screen.apply_translation((0, 0, 1))
    scene = scene_of(SLAB, lamp, opaque=screen)
    result, lost = subsurface_exitance(
        scene, medium_of(0.9, 30.0, 1.3), *middle(-0.05, 16), paths=64, seed=7
    )
    assert not result.mean.any()
    assert lost < 0.01


def test_straight_light_crosses_a_clear_matched_slab():
    """A lamp as high above the slab as that is thick: E at angle t is 100 cos(t)^3.

    The mean of that over cosine-distributed directions is 100 * 2 / 5.
    """
    lamp = PointLight(np.array([0.0, 0.0, 0.15]), np.array([1.0, 1.0, 1.0]))
    scene = scene_of(trimesh.creation.box((9, 9, 0.1)), lamp)
    result, _ = subsurface_exitance(
        scene, medium_of(0.5, 0.0, 1.0), *middle(-0.05, 64), paths=2048, seed=8
    )
    mean, sigma = total(result)
    assert (np.abs(mean - 40) < 4 * sigma).all()
    assert (sigma < 0.2).all()


# What comes with the mean


def test_walks_that_leave_through_a_hole_are_counted():
    points, normals = surface(BALL, 64)
    open_ball = BALL.copy()
    open_ball.update_faces(np.arange(len(BALL.faces)) % 10 > 0)
    for albedo, extinction in ((1, 0.0), (1, 3.0), (0.1, 3.0)):
        medium = medium_of(albedo, extinction, 1.0)
        scene = scene_of(open_ball, constant_sky())
        result, lost = subsurface_exitance(
            scene, medium, points, normals, paths=256, seed=9
        )
        assert 0.05 < lost < 0.2
        assert np.isfinite(result.mean).all()
        assert total(result)[0].max() < np.pi


def test_variance_is_that_of_the_mean():
    points, normals = middle(0.05, 5000)
    result, _ = subsurface_exitance(
        scene_of(SLAB, constant_sky()),
        medium_of((0.3, 0.6, 0.9), 10.0, 1.3),
        points,
        normals,
        paths=16,
        seed=10,
    )
    np.testing.assert_allclose(result.mean.var(0), result.variance.mean(0), rtol=0.1)


def test_seed_decides_and_chunks_are_joined(monkeypatch):
    points, normals = middle(0.05, 40)
    scene = scene_of(SLAB, constant_sky())

    def exitance(seed):
        medium = medium_of(0.5, 10.0, 1.3)
        return subsurface_exitance(scene, medium, points, normals, paths=32, seed=seed)

    one, _ = exitance(0)
    np.testing.assert_array_equal(one.mean, exitance(0)[0].mean)
    assert not np.array_equal(one.mean, exitance(1)[0].mean)
    monkeypatch.setattr(irradiance, "PATHS_PER_LAUNCH", 32 * 7)
    parts, _ = exitance(0)
    assert parts.mean.shape == parts.variance.shape == (40, 3)
    assert len(np.unique(parts.mean[:, 0])) > 30
    nothing = np.zeros((0, 3), np.float32)
    empty, lost = subsurface_exitance(
        scene, medium_of(0.5, 10.0, 1.3), nothing, nothing, paths=4, seed=0
    )
    assert empty.mean.shape == (0, 3)
    assert lost == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"albedo": np.array([0.5, 0.5, 1.1], np.float32)}, "albedo"),
        ({"albedo": np.array([0.5, -0.1, 0.5], np.float32)}, "albedo"),
        ({"albedo": np.array([0.5, np.nan, 0.5], np.float32)}, "albedo"),
        ({"extinction": -1.0}, "extinction"),
        ({"extinction": np.inf}, "extinction"),
        ({"extinction": np.nan}, "extinction"),
        ({"ior": 0.9}, "refraction"),
        ({"ior": 2.1}, "refraction"),
        ({"ior": np.nan}, "refraction"),
        ({"paths": 0}, "paths"),
        ({"seed": -1}, "seed"),
        ({"points": np.zeros((3, 2), np.float32)}, "N, 3"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, message):
    points, normals = middle(0.05, 3)
    given = {"albedo": np.full(3, 0.5, np.float32), "extinction": 1.0, "ior": 1.3}
    given |= {"points": points, "paths": 4, "seed": 0, **change}
    medium = Medium(given["albedo"], given["extinction"], given["ior"])
    with pytest.raises((InputError, TypeCheckError)) as caught:
        subsurface.subsurface_exitance(
            scene_of(SLAB, constant_sky()),
            medium,
            given["points"],
            normals,
            paths=given["paths"],
            seed=given["seed"],
        )
    if caught.type is InputError:
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


def test_scene_without_an_object_is_refused():
    scene = scene_of(SLAB, constant_sky())
    ground = scene.mesh._replace(material=np.ones_like(scene.mesh.material))
    with pytest.raises(InputError, match="material 0"):
        subsurface_exitance(
            scene._replace(mesh=ground),
            medium_of(0.5, 1.0, 1.3),
            *middle(0.05, 2),
            paths=1,
            seed=0,
        )

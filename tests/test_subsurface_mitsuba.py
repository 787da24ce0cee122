"""Subsurface scattering against Mitsuba's own volumetric paths."""

import numpy as np
import pytest
from media import BALL, SLAB, medium_of, scene_of, surface
from rooms import total

from ginn_jax import estimates
from ginn_jax.lighting import constant_sky
from ginn_jax.renderer import use_mitsuba
from ginn_jax.slab import single_scattering_albedo
from ginn_jax.subsurface import subsurface_exitance


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
        return estimates.summarize(values, paths)


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

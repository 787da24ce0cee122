"""Lists and bytes, as users have them, give what float32 arrays do."""

import numpy as np
import pytest
from media import scene_of
from refusals import BOX, SHAPE

from ginn_jax import irradiance, mesh, reference, samples, subsurface
from ginn_jax.lighting import constant_sky

NORMALS = np.tile(np.float32([[0, 1, 0], [1, 0, 0]]), (10, 1))
POINTS = NORMALS / 2
MATERIAL = np.zeros(20, np.int32)
MEDIUM = subsurface.Medium(np.full(3, 0.5), 1.0, 1.3)


def lit():
    return scene_of(SHAPE, constant_sky())


def occlusion(points, normals):
    return reference.ambient_occlusion(BOX, points, normals, 0.1, rays=4, seed=0)


def direct(points, normals):
    return irradiance.direct_irradiance(lit(), points, normals, looks=4, seed=0)


def indirect(points, normals):
    return irradiance.indirect_irradiance(lit(), points, normals, paths=4, seed=0)


def exitance(points, normals):
    ends = lit(), MEDIUM, points, normals
    return subsurface.subsurface_exitance(*ends, paths=4, seed=0)[0]


def ground(points, normals):
    cloud = samples.Samples(points, normals, MATERIAL)
    return samples.add_ground_samples(cloud, 0.1, seed=0)


@pytest.mark.parametrize("call", [occlusion, direct, indirect, exitance, ground])
def test_points_and_normals_of_any_type_do(call, unchecked):
    # Points that coincide have no density: these are apart.
    points = POINTS + np.arange(20, dtype=np.float32)[:, None] * np.float32(1e-3)
    wanted = call(points, NORMALS)
    for normals in (NORMALS.tolist(), NORMALS.astype(np.uint8)):
        for one, two in zip(call(points.tolist(), normals), wanted, strict=True):
            assert one.dtype == two.dtype
            np.testing.assert_array_equal(one, two)


def test_a_mesh_of_lists_stands_on_ground(unchecked):
    lists = mesh.Mesh(*(array.tolist() for array in BOX))
    for one, two in zip(mesh.add_ground(lists), mesh.add_ground(BOX), strict=True):
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)

"""Which samples of a scene light can reach."""

import numpy as np
import pytest
import rooms
import trimesh

from ginn_jax import objects, visible
from ginn_jax.errors import InputError
from ginn_jax.mesh import add_ground, make_mesh
from ginn_jax.reference import ambient_occlusion, build_scene
from ginn_jax.visible import visible_samples


def nested_boxes(path, sides):
    """A scene of cubes one inside the other, the outermost of side 1."""
    cubes = [trimesh.creation.box((side,) * 3) for side in sides]
    trimesh.util.concatenate(cubes).export(path)
    return build_scene(objects.load_object(objects.file_sources([path])[0]))


def test_visible_samples_are_of_the_outside_only(tmp_path):
    """The inner cube has as much as 49 parts in 100 of the area of the outer one."""
    scene = nested_boxes(tmp_path / "two.ply", (1.0, 0.7))
    samples = visible_samples(scene, 2000, seed=3)
    assert samples.position.shape == samples.normal.shape == (2000, 3)
    assert len(samples.material) == 2000
    cube = np.flatnonzero(samples.material == 0)
    centred = np.abs(samples.position[cube]).max(axis=1)
    np.testing.assert_allclose(centred, 0.5, atol=1e-5)
    # The five sides off the ground have alike many.
    side = np.argmax(np.abs(samples.normal[cube]), axis=1) * 2
    side += samples.normal[cube, side // 2] > 0
    free = np.delete(np.bincount(side, minlength=6), 2)
    assert free.min() > 0.8 * free.mean()


def test_a_sheet_is_sampled_from_both_sides_and_the_ground_from_above():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    sheet = make_mesh(corners, np.array([[0, 1, 2], [0, 2, 3]]))
    scene = build_scene(add_ground(sheet))
    samples = visible_samples(scene, 2000, seed=1)
    ground = samples.material == 1
    np.testing.assert_allclose(samples.normal[ground], [[0, 1, 0]] * ground.sum())
    front = samples.normal[~ground, 2] > 0
    assert 0.4 < front.mean() < 0.6
    one = visible_samples(scene, 2000, seed=1, both_sides=False)
    assert (one.normal[one.material == 0, 2] > 0.5).all()
    # As dense as the ground: a side has 1 of area, the ground 1.6 squared.
    assert ground.mean() == pytest.approx(2.56 / 4.56, abs=0.05)


def test_few_rays_tell_what_all_would():
    """In a well at whose bottom a few rays of a hundred leave."""
    well = rooms.cup()
    well = well._replace(vertices=well.vertices * np.float32([1, 4, 1]))
    scene = build_scene(well)
    samples = visible.sample_sides(well, 3000, 5, True)
    ends = samples.position, samples.normal
    cast = {"rays": visible.PROBE_RAYS, "seed": 5}
    sky = ambient_occlusion(scene, *ends, visible.out_of(scene), **cast).mean
    wanted = np.flatnonzero(sky > 0)
    assert np.count_nonzero((sky > 0) & (sky < 0.1)) > 100
    assert len(wanted) < len(sky) - 100
    for count in (len(wanted), 700):
        found = visible.reached_by_light(scene, samples, count, 5)
        np.testing.assert_array_equal(found, wanted[:count])


def test_sampling_checks_what_ray_casting_does():
    well = rooms.cup()
    assert len(visible_samples(build_scene(well), 0, seed=1).position) == 0
    with pytest.raises(InputError, match="seed"):
        visible_samples(build_scene(well), 100, seed=2**40)
    away = build_scene(well._replace(vertices=well.vertices + np.float32(1e7)))
    with pytest.raises(InputError, match="too short for coordinates"):
        visible_samples(away, 100, seed=1)


def test_the_inside_is_dropped_whatever_the_unit_of_length():
    """Millimetres: from one wall of the inner cube to the next it is 700."""
    cubes = [trimesh.creation.box((side,) * 3) for side in (1000.0, 700.0)]
    both = trimesh.util.concatenate(cubes)
    scene = build_scene(make_mesh(both.vertices, both.faces))
    found = visible_samples(scene, 500, seed=0).position
    np.testing.assert_allclose(np.abs(found).max(axis=1), 500, rtol=1e-5)


def test_a_scene_that_is_sealed_is_refused(tmp_path):
    scene = nested_boxes(tmp_path / "many.ply", np.linspace(1, 0.9, 200))
    with pytest.raises(InputError, match=r"^[^\n]*sealed[^\n]*$"):
        visible_samples(scene, 100, seed=0)

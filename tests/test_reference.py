"""Closed forms that ray tracing must reproduce, and the choice of libLLVM."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from jaxtyping import TypeCheckError

from ginn_jax import libllvm, reference
from ginn_jax.camera import Camera, orbit_camera
from ginn_jax.errors import InputError
from ginn_jax.mesh import Mesh

UP = np.array([0, 1, 0], np.float32)
REFUSED = (InputError, TypeCheckError)


def quad(corner, edge_u, edge_v):
    """A parallelogram as two triangles whose normal is edge_u x edge_v."""
    corner, u, v = np.array([corner, edge_u, edge_v], np.float32)
    vertices = np.stack([corner, corner + u, corner + u + v, corner + v])
    return joined([(vertices, np.array([[0, 1, 2], [0, 2, 3]]))])


def joined(parts, materials=None):
    vertices, faces, material, first = [], [], [], 0
    for i, (v, f) in enumerate(part[:2] for part in parts):
        vertices.append(v)
        faces.append(f + first)
        material.append(np.full(len(f), materials[i] if materials else 0))
        first += len(v)
    return Mesh(
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(material).astype(np.int32),
    )


def floor(half=1.0):
    return quad((-half, 0, -half), (0, 0, 2 * half), (2 * half, 0, 0))


def floor_and_wall(size):
    """A floor, and a wall in the plane x = 0 that stands on it."""
    wall = quad((0, 0, -size), (0, size, 0), (0, 0, 2 * size))
    return joined([floor(size), wall])


def upright(count, x=0.0):
    """`count` copies of one point on the floor at (x, 0, 0), with its normal."""
    points = np.tile(np.array([x, 0, 0], np.float32), (count, 1))
    return points, np.tile(UP, (count, 1))


def assert_mean(estimate, expected, slack=0.0):
    """The average over all points is `expected` within 5 of its standard deviations."""
    n = len(estimate.mean)
    sigma = np.sqrt(estimate.variance.astype(float).sum()) / n
    assert sigma > 0
    assert abs(estimate.mean.astype(float).mean() - expected) < 5 * sigma + slack


def segment(t):
    """Share of the unit disk with x > t: of cosine-weighted directions with d_x > t."""
    return (np.arccos(t) - t * np.sqrt(1 - t * t)) / np.pi


# Ambient occlusion


def test_lone_plane_is_open():
    points = np.random.default_rng(0).uniform(-1, 1, (5000, 3)).astype(np.float32)
    points[:, 1] = 0
    normals = np.tile(UP, (5000, 1))
    for r in (1e-3, 0.1, 100.0):
        result = reference.ambient_occlusion(
            floor(), points, normals, r, rays=64, seed=0
        )
        np.testing.assert_array_equal(result.mean, 1)
        np.testing.assert_array_equal(result.variance, 0)


def test_floor_of_a_closed_box_is_dark():
    box = trimesh.creation.box((1, 1, 1))
    points = np.random.default_rng(1).uniform(-0.499, 0.499, (5000, 3))
    points[:, 1] = -0.5
    mesh = joined([(box.vertices, box.faces)])
    normals = np.tile(UP, (5000, 1))
    result = reference.ambient_occlusion(
        mesh, points.astype(np.float32), normals, 2.0, rays=64, seed=0
    )
    np.testing.assert_array_equal(result.mean, 0)


def test_half_is_blocked_at_the_foot_of_a_wall():
    points, normals = upright(2000, x=1e-5)
    scene = floor_and_wall(100)
    result = reference.ambient_occlusion(scene, points, normals, 10.0, rays=256, seed=3)
    assert_mean(result, 0.5)


@pytest.mark.parametrize("distance", [0.02, 0.05, 0.09])
def test_wall_within_a_radius(distance):
    points, normals = upright(1000, x=-distance)
    result = reference.ambient_occlusion(
        floor_and_wall(1), points, normals, 0.1, rays=256, seed=4
    )
    assert_mean(result, 1 - segment(distance / 0.1))


@pytest.mark.parametrize("height", [0.02, 0.05, 0.09])
def test_ceiling_within_a_radius(height):
    """A ray at angle t meets a ceiling h above after h / cos t: (h/r)^2 stay open."""
    lid = floor()
    lid = (lid.vertices + height * UP, lid.faces)
    points, normals = upright(1000)
    result = reference.ambient_occlusion(
        joined([floor(), lid]), points, normals, 0.1, rays=256, seed=5
    )
    assert_mean(result, (height / 0.1) ** 2, slack=5e-4)


@pytest.mark.parametrize("rays", [2, 7, 16])
def test_variance_is_that_of_the_mean(rays):
    points, normals = upright(40_000, x=-0.02)
    result = reference.ambient_occlusion(
        floor_and_wall(1), points, normals, 0.1, rays=rays, seed=6
    )
    assert result.mean.var() == pytest.approx(result.variance.mean(), rel=0.05)


def test_seed_decides_and_chunks_do_not(monkeypatch):
    points, normals = upright(3000, x=-0.02)
    scene = reference.build_scene(floor_and_wall(1))

    def cast(count, seed, mesh=scene):
        return reference.ambient_occlusion(
            mesh, points[:count], normals[:count], 0.1, rays=16, seed=seed
        ).mean

    whole = cast(3000, 7)
    np.testing.assert_array_equal(whole, cast(3000, 7, mesh=floor_and_wall(1)))
    np.testing.assert_array_equal(whole[:1000], cast(1000, 7))
    monkeypatch.setattr(reference, "RAYS_PER_LAUNCH", 5000)
    np.testing.assert_array_equal(whole, cast(3000, 7))
    assert abs(np.corrcoef(whole, cast(3000, 8))[0, 1]) < 0.1
    assert abs(np.corrcoef(whole[1:], whole[:-1])[0, 1]) < 0.1


@pytest.mark.parametrize("axis", [0, 1, 2, (0, 1), (0, 2), (1, 2)])
def test_random_numbers_of_points_rays_and_seeds_are_independent(axis):
    """Averages over any of the three vary as much as those of independent numbers."""
    words = np.indices((1000, 16, 16), np.uint32)
    a, b = (word / 2**32 for word in reference.random_pair(*words))
    disk, checks = (a - 0.5) ** 2 + (b - 0.5) ** 2 < 0.1, (a * 64 % 2 < 1) ^ (b < 0.5)
    for event, p in [
        (a < 0.5, 0.5),
        (b < 0.1, 0.1),
        (disk, 0.1 * np.pi),
        (checks, 0.5),
    ]:
        mean = event.mean(axis)
        expected = p * (1 - p) * mean.size / event.size
        assert ((mean - p) ** 2).mean() / expected == pytest.approx(
            1, abs=5 * np.sqrt(2 / mean.size)
        )


def test_no_points_and_one_ray():
    nothing = np.zeros((0, 3), np.float32)
    result = reference.ambient_occlusion(floor(), nothing, nothing, 0.1, rays=4, seed=0)
    assert result.mean.shape == result.variance.shape == (0,)
    points, normals = upright(5)
    one = reference.ambient_occlusion(floor(), points, normals, 0.1, rays=1, seed=0)
    assert np.isnan(one.variance).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((3, 2), np.float32)}, "N, 3"),
        ({"normals": np.zeros((4, 3), np.float32)}, "N, 3"),
        ({"points": np.full((3, 3), np.nan, np.float32)}, "finite"),
        ({"normals": np.full((3, 3), np.nan, np.float32)}, "unit"),
        ({"normals": np.full((3, 3), 0.5, np.float32)}, "unit"),
        ({"radius": 0.0}, "radius"),
        ({"radius": np.inf}, "radius"),
        ({"rays": 0}, "rays"),
        ({"seed": -1}, "seed"),
        ({"mesh": floor()._replace(faces=np.zeros((0, 3), np.int32))}, "faces"),
        ({"mesh": floor()._replace(faces=floor().faces + 1)}, "outside"),
        ({"mesh": floor()._replace(vertices=floor().vertices * np.nan)}, "finite"),
    ],
)
def test_bad_input_is_refused_in_one_line(change, message):
    points, normals = upright(3)
    given = {"mesh": floor(), "points": points, "normals": normals, "radius": 0.1}
    with pytest.raises(REFUSED) as caught:
        reference.ambient_occlusion(**{"rays": 4, "seed": 0, **given, **change})
    if caught.type is InputError:
        assert message in str(caught.value)
        assert "\n" not in str(caught.value)


# G-buffer


def test_gbuffer_of_a_sphere():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    camera = orbit_camera(200.0, -40.0, 2.0, width=160, height=120)
    buffer = reference.render_gbuffer(joined([(ball.vertices, ball.faces)]), camera)
    position, normal = buffer.position[buffer.mask], buffer.normal[buffer.mask]
    distance = np.linalg.norm(position, axis=1)
    assert distance.min() > 0.498
    assert distance.max() < 0.5 + 1e-6
    assert (normal * position).sum(1).min() > 0.49
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, rtol=1e-5)
    assert ((np.array(camera.origin) - position) * normal).sum(1).min() > 0
    focal = 60 / np.tan(np.radians(35 / 2))
    silhouette = np.pi * (focal * 0.5) ** 2 / (2.0**2 - 0.5**2)
    assert buffer.mask.sum() == pytest.approx(silhouette, rel=0.01)
    for image in buffer[:3]:
        assert not image[~buffer.mask].any()


def test_gbuffer_pixels_are_where_the_camera_points():
    """The plane z = 0 from (0, 0, 3): each pixel's position is known exactly."""
    right = quad((0.5, -9, 0), (9, 0, 0), (0, 18, 0))
    left = quad((-9, -9, 0), (0, 18, 0), (9.5, 0, 0))  # wound the other way round
    mesh = joined([left, right], materials=[0, 1])
    camera = Camera(
        (0.0, 0.0, 3.0), (0.0, 0.0, 0.0), vertical_fov=90.0, width=64, height=48
    )
    buffer = reference.render_gbuffer(mesh, camera)
    assert buffer.mask.all()
    for row, column in [(0, 0), (0, 63), (47, 0), (20, 50)]:
        x = 3 * (column + 0.5 - 32) / 24
        y = 3 * (24 - row - 0.5) / 24
        np.testing.assert_allclose(buffer.position[row, column], (x, y, 0), atol=1e-5)
        assert buffer.material[row, column] == (x > 0.5)
    np.testing.assert_allclose(buffer.normal, np.broadcast_to([0, 0, 1], (48, 64, 3)))


def test_pixels_are_points():
    """AO of the pixels that see the foot of a wall is what its points have."""
    camera = Camera(
        (-0.04, 1.0, 0.0),
        (-0.04, 0.0, 0.0),
        up=(1.0, 0.0, 0.0),
        vertical_fov=1.0,
        width=40,
        height=40,
    )
    scene = reference.build_scene(floor_and_wall(2))
    buffer = reference.render_gbuffer(scene, camera)
    position, normal = buffer.position[buffer.mask], buffer.normal[buffer.mask]
    result = reference.ambient_occlusion(scene, position, normal, 0.1, rays=64, seed=9)
    assert_mean(result, 1 - segment(-position[:, 0] / 0.1).mean())


@pytest.mark.parametrize(
    "change",
    [
        {"origin": (0.0, 0.0, 0.0)},
        {"origin": (0.0, 1.0, 0.0)},
        {"origin": (0.0, 0.0, np.nan)},
        {"up": (0.0, 0.0, 0.0)},
        {"width": 0},
        {"height": -1},
        {"vertical_fov": 0.0},
        {"vertical_fov": 180.0},
    ],
)
def test_bad_camera_is_refused(change):
    given = {"origin": (0.0, 0.0, 1.0), "target": (0.0, 0.0, 0.0)}
    with pytest.raises(InputError, match="camera"):
        Camera(**{**given, **change})


@pytest.mark.parametrize(("elevation", "distance"), [(90.0, 2.0), (20.0, 0.0)])
def test_bad_orbit_is_refused(elevation, distance):
    with pytest.raises(InputError, match=r"elevation|distance"):
        orbit_camera(0.0, elevation, distance)


def test_callers_variant_is_put_back():
    import mitsuba

    reference.build_scene(floor())
    before = mitsuba.variant()
    mitsuba.set_variant("scalar_rgb")
    try:
        points, normals = upright(2)
        reference.ambient_occlusion(floor(), points, normals, 0.1, rays=2, seed=0)
        assert mitsuba.variant() == "scalar_rgb"
    finally:
        mitsuba.set_variant(before)


# The choice of libLLVM

NAMES = {
    "debian": "/usr/lib/x86_64-linux-gnu/libLLVM-{}.so.1",
    "debian_new": "/usr/lib/x86_64-linux-gnu/libLLVM.so.{}.1",
    "patch": "/usr/lib/x86_64-linux-gnu/libLLVM-{}.0.6.so.1",
    "fedora": "/usr/lib64/libLLVM-{}.so",
    "folder": "/usr/lib/llvm-{}/lib/libLLVM.so.1",
    "homebrew": "/opt/homebrew/Cellar/llvm/{}.1.7/lib/libLLVM.dylib",
    "homebrew_old": "/opt/homebrew/Cellar/llvm@{0}/{0}.1/lib/libLLVM.dylib",
}


@settings(deadline=None)
@given(st.lists(st.tuples(st.sampled_from(sorted(NAMES)), st.integers(7, 40))))
def test_newest_usable_libllvm_is_chosen(installed):
    paths = [NAMES[name].format(version) for name, version in installed]
    chosen = libllvm.choose_libllvm(paths)
    usable = [version for _, version in installed if version >= 17]
    if usable:
        assert chosen in paths
        assert libllvm.llvm_version(str(chosen))[0] == max(usable)
    else:
        assert chosen is None


def test_a_name_without_version_is_not_usable():
    assert libllvm.llvm_version("/usr/lib/libLLVM.so.1") == ()
    assert libllvm.choose_libllvm(["/usr/lib/libLLVM.so.1", "libLLVM.so"]) is None


OLD_ONLY = """
import sys
from ginn_jax import libllvm, renderer
from ginn_jax.errors import InputError
renderer._cuda_usable = lambda: False
libllvm.installed_libllvm = lambda: ["/usr/lib/llvm-14/lib/libLLVM-14.so.1"]
try:
    renderer.use_mitsuba()
except InputError as error:
    print(error)
assert "drjit" not in sys.modules
"""


@pytest.mark.parametrize("named", [None, "/nowhere/libLLVM.so.19.1"])
def test_old_or_missing_libllvm_is_one_line_and_no_abort(monkeypatch, named):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    if named:
        monkeypatch.setenv("DRJIT_LIBLLVM_PATH", named)
    done = subprocess.run(
        [sys.executable, "-c", OLD_ONLY], capture_output=True, text=True, check=True
    )
    (line,) = done.stdout.splitlines()
    assert ("names no file" if named else "libLLVM-14.so.1): `apt-get install") in line

import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from experiments.shape_sheet import contact_sheet
from ginn_jax import clad_shapes, curved_shapes, reference, sdf, shapes, solids
from ginn_jax.mesh import add_ground, make_mesh
from ginn_jax.samples import sample_surface

SEED = st.integers(0, 2**31 - 1)


def assert_closed(mesh):
    """Each edge, by position, is run through as often one way as the other."""
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    faces, balance = place.ravel()[mesh.faces].tolist(), {}
    for a, b, c in faces:
        for start, end in ((a, b), (b, c), (c, a)):
            edge = (min(start, end), max(start, end))
            balance[edge] = balance.get(edge, 0) + (1 if start < end else -1)
    assert not any(balance.values())


def signed_volume(vertices, faces):
    return np.linalg.det(np.asarray(vertices, float)[faces]).sum() / 6


def check_shape(mesh, closed):
    if closed:
        assert_closed(mesh)
    assert signed_volume(mesh.vertices, mesh.faces) > 1e-4
    assert len(mesh.faces) <= shapes.MOST_FACES
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    assert (high - low).max() == pytest.approx(1, abs=1e-5)
    np.testing.assert_allclose(low, -high, atol=1e-5)


@pytest.mark.parametrize("name", shapes.FAMILIES)
def test_each_family_is_closed_and_faces_outward(name):
    for seed in range(3):
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # nothing was dropped or turned
            mesh = shapes.shape_of(name, np.random.default_rng(seed))
        check_shape(mesh, closed=not shapes.FAMILIES[name].clad)


@pytest.mark.parametrize("name", shapes.FAMILIES)
def test_most_of_each_family_is_seen_from_outside(name):
    seen = []
    for seed in range(3):
        mesh = add_ground(shapes.shape_of(name, np.random.default_rng(seed)))
        points = sample_surface(mesh, 1000, seed=0)
        shade = reference.ambient_occlusion(
            mesh, points.position, points.normal, 10.0, rays=32, seed=0
        )
        seen.append((shade.mean > 0).mean())
    assert np.mean(seen) > 0.6


@given(hnp.arrays(float, 3, elements=st.floats(0.01, 1)), st.integers(2, 9))
def test_solids_that_touch_come_to_overlap(size, count):
    starts = np.arange(count)[:, None] * [size[0], 0, 0]
    row = [solids.block(start, start + size) for start in starts]
    parts = solids.join(row).split(only_watertight=False)
    bounds = np.array(sorted(part.bounds.tolist() for part in parts))
    overlap = bounds[:-1, 1, 0] - bounds[1:, 0, 0]
    assert len(parts) == count
    assert (overlap > 9e-5 * size[0]).all()
    assert (overlap < 2.1e-4 * size[0]).all()
    heights = bounds[:, 1, 1].tolist()
    assert len(set(heights)) == count  # tops that were in one plane are apart


@settings(max_examples=25, deadline=None)
@given(SEED)
def test_a_vessel_holds_more_than_its_wall_takes(seed):
    solid = curved_shapes.vessel(np.random.default_rng(seed))
    body = solid.split(only_watertight=False)[0]
    assert 0 < body.volume < 0.75 * body.convex_hull.volume


@settings(max_examples=25, deadline=None)
@given(SEED)
def test_a_wheel_is_closed_and_mostly_air(seed):
    solid = curved_shapes.wheel(np.random.default_rng(seed))
    assert solid.is_watertight
    assert 0 < solid.volume < 0.5 * solid.convex_hull.volume


AXES = hnp.arrays(float, (3, 3), elements=st.floats(-1, 1)).filter(
    lambda a: abs(np.linalg.det(a)) > 0.05
)


@given(AXES, st.booleans())
def test_a_plate_faces_outward_and_lacks_its_back_if_open(axes, opened):
    along, up, out = axes
    slab = clad_shapes.plate(np.ones(3), along, up, 1.0, out, opened)
    assert len(slab.faces) == (10 if opened else 12)
    middle = np.ones(3) + out / 2
    outward = slab.triangles_center - middle
    assert ((slab.face_normals * outward).sum(1) > 0).all()
    back = np.linalg.norm(np.cross(along, up))
    assert slab.area == pytest.approx(_box_area(axes) - opened * back)


def _box_area(axes):
    sides = [np.cross(axes[i], axes[i - 1]) for i in range(3)]
    return 2 * sum(np.linalg.norm(side) for side in sides)


@settings(max_examples=10, deadline=None)
@given(SEED)
def test_random_shapes_are_valid_and_deterministic(seed):
    first, again = shapes.random_shape(seed), shapes.random_shape(seed)
    family = shapes.FAMILIES[shapes.draw_family(np.random.default_rng(seed))]
    check_shape(first, closed=not family.clad)
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    other = shapes.random_shape(seed + 1)
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(
        first.vertices, other.vertices
    )


def test_every_family_is_drawn(monkeypatch):
    drawn = set()
    mesh = make_mesh(np.eye(3), np.array([[0, 1, 2]]))
    monkeypatch.setattr(shapes, "shape_of", lambda name, _: drawn.add(name) or mesh)
    for seed in range(300):
        shapes.random_shape(seed)
    assert drawn == set(shapes.FAMILIES)


@given(SEED)
def test_closed_shapes_are_the_others_wherever_those_are_closed(seed):
    open_or_not = shapes.draw_family(np.random.default_rng(seed))
    closed = shapes.draw_family(np.random.default_rng(seed), closed=True)
    assert not shapes.FAMILIES[closed].clad
    assert closed == open_or_not or shapes.FAMILIES[open_or_not].clad


@settings(max_examples=15, deadline=None)
@given(st.floats(0.2, 0.8), st.floats(0.2, 0.8))
def test_marching_cubes_gives_the_volume_of_the_solid(a, b):
    half = np.array([a, b, 0.5])
    place = np.array([0.05, -0.1, 0.1])
    ball = sdf.to_solid(sdf.field_of([sdf.Part(sdf.ellipsoid(half), 0.9, place)]))
    volume = signed_volume(ball.vertices, ball.faces)
    assert volume == pytest.approx(4 / 3 * np.pi * half.prod(), rel=0.05)
    block = sdf.to_solid(sdf.field_of([sdf.Part(sdf.box(half), 1.3, place)]))
    volume = signed_volume(block.vertices, block.faces)
    assert volume == pytest.approx(8 * half.prod(), rel=0.05)


def test_marching_cubes_gives_one_piece_without_hidden_hollows():
    def ball(radius, x, cut=False):
        round_ = sdf.ellipsoid(np.full(3, radius))
        return sdf.Part(round_, radius, np.array([x, 0.1, 0.0]), cut=cut)

    alone = sdf.to_solid(sdf.field_of([ball(0.5, -0.4)]))
    hollow = ball(0.3, -0.4, cut=True)
    same = sdf.to_solid(sdf.field_of([ball(0.2, 0.6), ball(0.5, -0.4), hollow]))
    assert len(same.split()) == 1
    assert same.volume == pytest.approx(alone.volume, rel=1e-3)
    assert len(sdf.to_solid(sdf.field_of([])).faces) == 0


def test_contact_sheet_holds_every_shape():
    sheet = contact_sheet(range(8), 24)
    assert sheet.shape == (48, 144)
    for row in (0, 24):
        for column in range(0, 144, 24):
            cell = sheet[row : row + 24, column : column + 24]
            assert (cell.min() < 200) == (row == 0 or column < 48)


@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(0.1, 1), min_size=2, max_size=6),
    st.integers(1, 8),
    st.floats(0.05, 0.2),
)
def test_solids_have_the_volume_they_should(radii, sections, thin):
    height = np.arange(len(radii)) * 0.5
    body = solids.turned(solids.profile(radii, height), 6 * sections)
    sector = 6 * sections * np.sin(2 * np.pi / (6 * sections)) / 2
    r, s = np.array(radii[:-1]), np.array(radii[1:])
    frusta = sector * 0.5 / 3 * (r**2 + r * s + s**2).sum()
    assert signed_volume(body.vertices, body.faces) == pytest.approx(frusta, rel=1e-4)
    flat = solids.sheet(lambda x, z: 0.3 * x * z, thin)
    assert signed_volume(flat.vertices, flat.faces) == pytest.approx(4 * thin, rel=1e-6)
    angle = np.linspace(0, 2 * np.pi, 200, endpoint=False)
    ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    octagon = 2 * 2**0.5 * thin**2
    for closed, length in ((True, 2 * np.pi), (False, 2 * np.pi * 199 / 200)):
        tube = solids.tube(ring, thin, closed=closed)
        volume = signed_volume(tube.vertices, tube.faces)
        assert volume == pytest.approx(octagon * length, rel=0.02)
        assert_closed(make_mesh(tube.vertices, tube.faces))

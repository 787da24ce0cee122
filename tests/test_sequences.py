"""Animations: samples stay on their faces, and flicker is what the reference lacks."""

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from experiments.animation import Options, choose_sequences
from ginn_jax import sequences
from ginn_jax.errors import InputError

DATA = sequences.procedural_animation(3, 5)


def test_frames_share_a_unit_box_and_a_ground():
    meshes = sequences.frames_of(DATA, 5, ground=True)
    places = np.stack([m.vertices[:-4] for m in meshes])
    extent = places.max(axis=(0, 1)) - places.min(axis=(0, 1))
    assert extent.max() == pytest.approx(1.0, abs=1e-5)
    floors = np.stack([m.vertices[-4:] for m in meshes])
    np.testing.assert_array_equal(floors, floors[:1].repeat(5, axis=0))
    gap = places[..., 1].min() - floors[0, 0, 1]
    assert 0 < gap < 1e-3
    assert np.abs(np.diff(places, axis=0)).max() > 1e-3


@pytest.mark.parametrize("ground", [False, True])
def test_few_frames_are_the_first_of_all(ground):
    """In the box of the whole animation, not of theirs."""
    few, every = (sequences.frames_of(DATA, n, ground) for n in (2, 5))
    for one, two in zip(few, every[:2], strict=True):
        np.testing.assert_array_equal(one.vertices, two.vertices)


@pytest.mark.parametrize("frames", [2, 3])
def test_a_procedural_animation_of_few_frames_moves(frames):
    places = sequences.procedural_animation(3, frames).vertices
    assert np.abs(places[1] - places[0]).max() > 0.02


def test_samples_move_with_their_faces():
    meshes = sequences.frames_of(DATA, 5, ground=True)
    carried = sequences.carried_samples(meshes[0], 500, seed=1)
    np.testing.assert_allclose(carried.barycentric.sum(1), 1, atol=1e-4)
    assert carried.barycentric.min() > -1e-4
    for mesh in meshes:
        samples = sequences.samples_at(mesh, carried)
        corners = mesh.vertices[mesh.faces[carried.face]].astype(float)
        off = samples.position - corners[:, 0]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        across *= np.where(carried.behind, -1, 1)[:, None]
        np.testing.assert_allclose((off * across).sum(1), 0, atol=1e-5)
        np.testing.assert_allclose(samples.normal, across, atol=1e-4)
        np.testing.assert_array_equal(samples.material, mesh.material[carried.face])


def test_a_sheet_is_sampled_on_both_sides_and_what_is_inside_out_outside():
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    moving = np.stack([corners, corners + np.float32([0, 0, 0.1])])
    sheet = sequences.Animation(moving, np.array([[0, 1, 2], [0, 2, 3]]))
    [mesh, _] = sequences.frames_of(sheet, 2, ground=False)
    samples = sequences.samples_at(mesh, sequences.carried_samples(mesh, 400, seed=0))
    assert 0.4 < (samples.normal[:, 2] > 0).mean() < 0.6
    ball = trimesh.creation.icosphere(2)
    inside_out = sequences.Animation(
        np.stack([ball.vertices] * 2).astype(np.float32), ball.faces[:, ::-1]
    )
    [mesh, _] = sequences.frames_of(inside_out, 2, ground=False)
    for both in (True, False):
        carried = sequences.carried_samples(mesh, 400, both, seed=0)
        samples = sequences.samples_at(mesh, carried)
        assert ((samples.position * samples.normal).sum(axis=1) > 0).all()


def test_samples_of_a_face_that_collapses_have_a_normal():
    [mesh, _] = sequences.frames_of(DATA, 2, ground=False)
    carried = sequences.carried_samples(mesh, 400, seed=0)
    flat = mesh.vertices.copy()
    flat[mesh.faces[carried.face[0]]] = flat[mesh.faces[carried.face[0], 0]]
    samples = sequences.samples_at(mesh._replace(vertices=flat), carried)
    length = np.linalg.norm(samples.normal, axis=1)
    np.testing.assert_allclose(length, 1, atol=1e-4)
    behind = -1 if carried.behind[0] else 1
    np.testing.assert_array_equal(samples.normal[0], [0, behind, 0])


def test_samples_of_nested_boxes_are_of_the_outermost_alone():
    """Most of what is drawn first lies inside: more is drawn until there are enough."""
    boxes = [trimesh.creation.box((side,) * 3) for side in np.linspace(1, 0.9, 20)]
    nested = trimesh.util.concatenate(boxes)
    still = sequences.Animation(
        np.stack([nested.vertices] * 2).astype(np.float32),
        nested.faces.astype(np.int32),
    )
    [mesh, _] = sequences.frames_of(still, 2, ground=False)
    carried = sequences.carried_samples(mesh, 400, seed=0)
    samples = sequences.samples_at(mesh, carried)
    assert len(samples.position) == 400
    np.testing.assert_allclose(np.abs(samples.position).max(axis=1), 0.5, atol=1e-5)


frames = hnp.arrays(np.float32, (4, 6), elements=st.floats(0, 1, width=32))


@given(frames, frames, st.floats(-1, 1, width=32))
def test_flicker_forgives_what_stands_still(reference, images, offset):
    seen, nothing = np.ones((4, 6), bool), np.zeros((4, 6), np.float32)
    constant = sequences.flicker(reference + offset, reference, nothing, seen)
    assert constant == pytest.approx(0, abs=1e-10)
    by_hand = 0.0
    for t in range(3):
        for p in range(6):
            mine = float(images[t + 1, p]) - float(images[t, p])
            right = float(reference[t + 1, p]) - float(reference[t, p])
            by_hand += (mine - right) ** 2 / 18
    found = sequences.flicker(images, reference, nothing, seen)
    assert found == pytest.approx(by_hand, abs=1e-6)


def test_flicker_of_a_noisy_reference_is_that_of_the_truth():
    rng = np.random.default_rng(0)
    truth = rng.uniform(size=(12, 20_000))
    images = truth + 0.1 * rng.normal(size=truth.shape)
    noisy = truth + 0.2 * rng.normal(size=truth.shape)
    seen, variance = np.ones(truth.shape, bool), np.full(truth.shape, 0.04)
    assert sequences.flicker(images, noisy, variance, seen) == pytest.approx(
        0.02, rel=0.05
    )


def test_flicker_counts_pixels_seen_in_both_frames():
    images = np.array([[0.0, 0.0], [1.0, 5.0]], np.float32)
    nothing = np.zeros_like(images)
    seen = np.array([[True, False], [True, True]])
    assert sequences.flicker(images, nothing, nothing, seen) == 1.0


def test_what_is_no_animation_is_refused(tmp_path):
    good = {"vertices": DATA.vertices, "faces": DATA.faces}
    path = tmp_path / "a.npz"
    np.savez(path, **good)
    assert sequences.load_animation(path).vertices.shape == DATA.vertices.shape
    broken = {
        "nothing of faces": {"vertices": DATA.vertices},
        "one frame": good | {"vertices": DATA.vertices[:1]},
        "flat": good | {"vertices": DATA.vertices[..., :2]},
        "nan": good | {"vertices": np.nan * DATA.vertices},
        "outside": good | {"faces": DATA.faces + 10**6},
        "negative": good | {"faces": DATA.faces - 10**6},
        "no faces": good | {"faces": DATA.faces[:0]},
        "halves": good | {"faces": DATA.faces + 0.5},
        "words": good | {"vertices": DATA.vertices.astype(str)},
    }
    for arrays in broken.values():
        np.savez(path, **arrays)
        with pytest.raises(InputError, match=r"a\.npz"):
            sequences.load_animation(path)
    path.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(InputError, match="not an"):
        sequences.load_animation(path)
    with path.open("wb") as file:
        np.save(file, DATA.vertices)
    with pytest.raises(InputError, match="not an"):
        sequences.load_animation(path)
    with pytest.raises(InputError, match="no such"):
        sequences.load_animation(tmp_path / "b.npz")
    one = np.zeros((2, 3, 3), np.float32)
    with pytest.raises(InputError, match="coincide"):
        sequences.frames_of(sequences.Animation(one, np.array([[0, 1, 2]])), 2, False)


def test_a_folder_stands_for_its_animations_sorted(tmp_path):
    with pytest.raises(InputError, match="no animation in this folder"):
        sequences.find_animations(tmp_path)
    (tmp_path / "sub").mkdir()
    for name in ("b.npz", "a.npz", "sub/c.npz", "notes.txt", "._a.npz"):
        (tmp_path / name).touch()
    found = sequences.find_animations(tmp_path)
    assert [path.name for path in found] == ["a.npz", "b.npz", "c.npz"]
    missing = tmp_path / "d.npz"
    assert sequences.find_animations(missing) == [missing]


def test_sequences_of_one_file_name_are_all_kept(tmp_path):
    for scene, scale in (("a", 1), ("b", 3)):
        (tmp_path / scene).mkdir()
        wide = DATA.vertices * np.float32([scale, 1, 1])
        np.savez(tmp_path / scene / "walk", vertices=wide, faces=DATA.faces)
    options = Options(animation=tmp_path, frames=2)
    found = choose_sequences(options, ground=True)
    assert list(found) == ["a_walk", "b_walk"]
    assert not np.array_equal(*(found[name][0].vertices for name in found))

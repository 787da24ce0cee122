import itertools

import jax
import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st

from ginn_jax import dataset
from ginn_jax.errors import InputError
from ginn_jax.presets import PRESETS

ORIGIN = {"seed": 3, "radius": 0.1, "object": "shape_3"}


def cloud_of(count, seed=0):
    """Random numbers in every field."""
    rng = np.random.default_rng(seed)
    shapes = [(count, 3), (count, 3), (count,), (count,)]
    return dataset.ShadedPoints(
        *(rng.normal(size=s).astype(np.float32) for s in shapes)
    )


@pytest.fixture
def saved(tmp_path):
    """A cloud and the file that it lies in."""
    cloud, path = cloud_of(50), tmp_path / "cloud.npz"
    dataset.save_cloud(path, cloud, ORIGIN)
    return cloud, path


def assert_refused(path, origin=None):
    """Loading ends in one line that names the file."""
    with pytest.raises(InputError) as caught:
        dataset.load_cloud(path, origin)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


def test_cloud_comes_back(saved):
    cloud, path = saved
    assert tiny.identical(dataset.load_cloud(path, ORIGIN), cloud)
    assert tiny.identical(dataset.load_cloud(path), cloud)
    assert list(path.parent.iterdir()) == [path]


def test_killed_save_leaves_the_old_file(saved, monkeypatch):
    cloud, path = saved

    def die(file, **arrays):
        file.write(b"half a cl")
        raise KeyboardInterrupt

    monkeypatch.setattr(dataset.np, "savez", die)
    with pytest.raises(KeyboardInterrupt):
        dataset.save_cloud(path, cloud_of(60), ORIGIN)
    monkeypatch.undo()
    assert tiny.identical(dataset.load_cloud(path, ORIGIN), cloud)


def test_missing_file_is_refused(tmp_path):
    assert "no such" in assert_refused(tmp_path / "nothing.npz")


@pytest.mark.parametrize("share", [0, 0.01, 0.5, 0.95, 0.999])
def test_truncated_file_is_refused(saved, share):
    _, path = saved
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    assert "damaged" in assert_refused(path, ORIGIN)


@pytest.mark.parametrize("content", [b"text", b"\x80\x04K\x01.", b"PK\x03\x04" * 9])
def test_something_else_is_refused(tmp_path, content):
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    assert_refused(path)


def test_no_flipped_byte_goes_unnoticed(saved):
    cloud, path = saved
    whole = path.read_bytes()
    caught = 0
    for place in np.random.default_rng(0).permutation(len(whole))[:400]:
        flipped = bytearray(whole)
        flipped[place] ^= 0xFF
        path.write_bytes(flipped)
        try:
            assert tiny.identical(dataset.load_cloud(path, ORIGIN), cloud)
        except InputError:
            caught += 1
    assert caught > 200


def test_bare_array_is_refused(tmp_path):
    with open(tmp_path / "array.npz", "wb") as file:
        np.save(file, np.zeros(3))
    assert_refused(tmp_path / "array.npz")


def test_missing_field_is_refused(tmp_path):
    path, fields = tmp_path / "old.npz", cloud_of(5)._asdict()
    del fields["variance"]
    np.savez(path, origin="{}", **fields)
    assert_refused(path)


def test_other_origin_is_refused(saved):
    _, path = saved
    for name in ORIGIN:
        assert "other settings" in assert_refused(path, ORIGIN | {name: 4})
    assert_refused(path, ORIGIN | {"rays": 4})


@given(st.integers(0, 2**31 - 1))
def test_rotation_turns_normals_with_positions(seed):
    cloud = cloud_of(30)
    turned = dataset.rotate_about_up(cloud, key=jax.random.key(seed))
    p, n, q, m = (
        np.asarray(a, np.float64)
        for a in (cloud.position, cloud.normal, turned.position, turned.normal)
    )
    np.testing.assert_allclose(q[:, 1], p[:, 1], atol=1e-6)
    np.testing.assert_allclose(m[:, 1], n[:, 1], atol=1e-6)
    before = np.einsum("ik,ijk->ij", n, p[:, None] - p)
    after = np.einsum("ik,ijk->ij", m, q[:, None] - q)
    np.testing.assert_allclose(after, before, atol=2e-5)
    np.testing.assert_allclose(q @ q.T, p @ p.T, atol=2e-5)
    np.testing.assert_allclose(m @ m.T, n @ n.T, atol=2e-5)
    # A turn, not a reflection.
    volume = [np.linalg.det(a[:3] - a[3:6]) for a in (p, q)]
    np.testing.assert_allclose(volume[1], volume[0], atol=1e-4)
    assert tiny.identical(
        (turned.target, turned.variance), (cloud.target, cloud.variance)
    )


def test_rotation_reaches_every_azimuth():
    east = dataset.ShadedPoints(
        np.array([[1, 0, 0]], np.float32),
        np.array([[1, 0, 0]], np.float32),
        *cloud_of(1)[2:],
    )
    keys = jax.random.split(jax.random.key(0), 400)
    x, _, z = jax.vmap(lambda k: dataset.rotate_about_up(east, key=k).position[0])(
        keys
    ).T
    counts, _ = np.histogram(np.arctan2(z, x), bins=8, range=(-np.pi, np.pi))
    assert counts.min() > 25


def test_clouds_stand_side_by_side_out_of_reach():
    clouds = [tiny.sphere_on_plane(200, seed) for seed in range(3)]
    keys = jax.random.split(jax.random.key(1), 3)
    batch = dataset.stack_clouds(clouds)
    batch = jax.vmap(lambda c, k: dataset.rotate_about_up(c, key=k))(batch, keys)
    joined = dataset.side_by_side(batch)
    assert joined.position.shape == (600, 3)
    parts = np.array(joined.position, np.float64).reshape(3, 200, 3)
    for part, alone in zip(parts, batch.position, strict=True):
        np.testing.assert_allclose(
            np.linalg.norm(part[:, None] - part, axis=-1),
            np.linalg.norm(alone[:, None] - alone[None], axis=-1),
            atol=1e-5,
        )
    rows = [c for p in PRESETS.values() for c in (*p.encoder, p.query)]
    reach = max(c.radius for c in rows)
    for one, two in itertools.combinations(parts, 2):
        assert np.linalg.norm(one[:, None] - two, axis=-1).min() > reach
    rest = [np.asarray(a).reshape(600, -1) for a in batch[1:4]]
    for field, expected in zip(joined[1:4], rest, strict=True):
        np.testing.assert_array_equal(np.asarray(field).reshape(600, -1), expected)


def test_oriented_masks_nothing():
    points = dataset.oriented(cloud_of(4))
    assert points.mask.tolist() == [True] * 4


@pytest.mark.parametrize(("clouds", "size"), [(7, 3), (6, 2), (2, 5), (1, 1)])
def test_every_epoch_is_a_permutation(clouds, size):
    orders = [dataset.batch_order(clouds, size, s, seed=4) for s in range(5 * clouds)]
    epochs = np.concatenate(orders).reshape(-1, clouds)
    np.testing.assert_array_equal(
        np.sort(epochs), np.tile(np.arange(clouds), (5 * size, 1))
    )
    if clouds > 5:
        assert len({tuple(e) for e in epochs}) > 2


def test_order_depends_on_seed_and_step_only():
    def run(seed):
        return [dataset.batch_order(50, 4, s, seed=seed).tolist() for s in (9, 0, 3, 9)]

    assert run(1) == run(1)
    assert run(1)[0] == run(1)[3] != run(1)[1]
    assert run(1) != run(2)

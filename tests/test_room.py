"""Two sizes of room for a step: which batches take which, and that neither shows."""

from dataclasses import replace

import jax
import numpy as np
import tiny
from hypothesis import given
from hypothesis import strategies as st

from ginn_jax import fit, room
from ginn_jax.limits import limits_for, suffices_for
from ginn_jax.lit_clouds import LitCloud

CONFIG = replace(
    tiny.CONFIG, network=tiny.ONE_LEVEL, points=200, queries=32, steps=6, batch_size=1
)
DEMANDS = st.lists(
    st.fixed_dictionaries({n: st.integers(0, 1 << 24) for n in "ab"}), min_size=1
)


@given(DEMANDS, st.floats(0, 1))
def test_a_share_of_the_demands_is_held_of_each_name(demands, share):
    enough = suffices_for(share, demands)
    for name, size in enough.items():
        found = [d[name] for d in demands]
        assert size in found
        held = sum(n <= size for n in found)
        assert held >= share * (len(found) - 1)
        assert sum(n < size for n in found) <= share * (len(found) - 1) + 1


@given(DEMANDS)
def test_all_demands_are_held_of_every_name(demands):
    limits = limits_for(suffices_for(1.0, demands), 1.0)
    assert all(limits.of(name) >= n for d in demands for name, n in d.items())


def clouds():
    """Five that are alike, and one whose points crowd."""
    made = [tiny.sphere_on_plane(CONFIG.points, seed) for seed in range(6)]
    made[3].position[:] *= 0.2
    return made


def train(folder):
    notes = []
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        fit.train_step.clear_cache()
        given = CONFIG, clouds(), folder, fit.Intervals(report=1, save=6)
        found = fit.fit(*given, lambda step, loss, note: notes.append(note))
    return found, [n for n in notes if n], fit.train_step._cache_size()


def test_what_is_not_usual_has_room_and_is_learned_the_same(tmp_path, monkeypatch):
    whole, notes, programs = train(tmp_path / "one")
    assert (notes, programs) == ([], 1)
    monkeypatch.setattr(room, "WORTH_COMPILING", 1)
    monkeypatch.setattr(room, "USUAL_SHARE", 0.5)
    both, notes, programs = train(tmp_path / "two")
    assert (notes, programs) == ([], 2)
    assert both.raised == {}
    np.testing.assert_allclose(both.losses, whole.losses, rtol=1e-4)


def test_usual_room_is_smaller_and_holds_most(monkeypatch):
    monkeypatch.setattr(room, "WORTH_COMPILING", 1)
    found = room.training_room(CONFIG, clouds())
    usual, most = dict(found.usual.sizes), dict(found.most.sizes)
    assert all(usual[name] <= most[name] for name in most)
    assert sum(usual.values()) < sum(most.values())


def test_every_colour_of_every_cloud_is_trained_on():
    def made(number):
        points = tiny.sphere_on_plane(8, 0)
        color = np.tile(np.float32([1, 2, 3]) + 10 * number, (8, 1))
        albedo, none = np.ones((1, 3), np.float32), np.zeros(0)
        known = np.zeros(8, np.int32), color, color, color, albedo, none
        return LitCloud(*points[:2], *known)

    config, clouds = replace(tiny.CONFIG, batch_size=2), [made(0), made(1)]
    batches = [fit.step_batch(config, clouds, step) for step in range(60)]
    found = {float(t) for batch in batches for t in batch.target[:, 0]}
    assert found == {1, 2, 3, 11, 12, 13}
    for batch in batches:
        np.testing.assert_array_equal(batch.light[..., 0], batch.target)
        np.testing.assert_array_equal(batch.variance, batch.target)

"""Training goes on whatever is in the data, and refuses what it cannot learn from."""

from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import tiny
from short_run import CONFIG, cloud, train

from ginn_jax import checkpoint, dataset, fit, room
from ginn_jax.errors import InputError
from ginn_jax.presets import only_2d


def stressful():
    """Six clouds that stay, each bad in its own way, and one that cannot be learned."""
    sun = np.ones(CONFIG.points)
    sun[7] = 1e5
    heap, far, nan = cloud(2), cloud(4), cloud(5)
    heap.position[:] = heap.position[0]
    far.position[::9] *= 1e4
    nan.target[::2] = np.nan
    return [cloud(0), cloud(1, sun), heap, cloud(3, 0.0), far, nan]


def assert_finite(tree):
    leaves = [np.asarray(a) for a in jax.tree.leaves(tree)]
    assert all(np.isfinite(a).all() for a in leaves if a.dtype.kind == "f")


def bad_steps(clouds):
    """How many steps take the cloud whose target is not a number."""
    orders = [
        dataset.batch_order(len(clouds), 1, s, seed=CONFIG.seed)
        for s in range(CONFIG.steps)
    ]
    return sum(not np.isfinite(clouds[int(o[0])].target).all() for o in orders)


def test_training_goes_on(tmp_path, monkeypatch):
    """One cloud is probed for capacities, so that others exceed them on the way."""
    monkeypatch.setattr(room, "PROBES", 1)
    # What is raised holds more of the others too: a program less.
    monkeypatch.setattr(room, "SLACK", 4.0)
    clouds, notes = stressful(), []
    found = train(tmp_path, clouds, progress=lambda s, x, note: notes.append(note))
    bad = bad_steps(clouds)
    assert bad == CONFIG.steps // len(clouds)
    assert (int(found.state.step), int(found.state.skipped)) == (CONFIG.steps, bad)
    assert np.isfinite(found.losses).sum() == CONFIG.steps - bad
    assert len(found.losses) == CONFIG.steps
    assert_finite((found.state.variables, found.state.optimizer))
    # The heap wants more pairs than the first cloud did: said, and raised once.
    assert "level_0.edges" in found.raised
    assert len([n for n in notes if "level_0.edges" in n]) <= 2
    # Two or three programs of a step are all that a process has memory maps for.
    assert fit.train_step._cache_size() == 1
    weights = checkpoint.load_weights(tmp_path)[2]
    assert_finite(weights)


@pytest.mark.parametrize(
    ("radius", "sizes", "message"),
    [
        (
            1e-4,
            (1200, 1200),
            "step 0 has no points left to ask for: all are in level 0",
        ),
        (0.08, (1200, 1300), "clouds have from 1200 to 1300 points: cut them"),
    ],
)
def test_training_on_nothing_is_refused(tmp_path, monkeypatch, radius, sizes, message):
    network = only_2d(replace(tiny.ONE_LEVEL, levels=(radius,)))
    monkeypatch.setattr(fit, "training_room", lambda *_: tiny.ample_room(network))
    clouds = [tiny.sphere_on_plane(n, i) for i, n in enumerate(sizes)]
    config = replace(tiny.CONFIG, network=network, steps=3)
    optax = jax.numpy_dtype_promotion("standard")
    refused = pytest.raises(InputError, match=message)
    with tiny.cheap_compiling(), optax, refused:
        fit.fit(config, clouds, tmp_path, fit.Intervals(), lambda *_: None)


@pytest.mark.parametrize("written", [True, False])
def test_a_run_that_fails_waits_for_what_it_saves(tmp_path, monkeypatch, written):
    """And says why it failed, not that it could not save."""
    manager, closed = checkpoint.open_manager(tmp_path), []
    close = manager.close

    def closing():
        closed.append(close())
        if not written:
            raise ValueError("no space left")

    def fails(*_):
        raise InputError("step 0 has no points left to ask for")

    monkeypatch.setattr(fit, "training_room", lambda *_: tiny.ONE_LEVEL_ROOM)
    monkeypatch.setattr(manager, "close", closing)
    monkeypatch.setattr(fit, "open_manager", lambda *_, **__: manager)
    monkeypatch.setattr(fit, "init_state", lambda *_: SimpleNamespace(step=0))
    monkeypatch.setattr(fit, "step_with_room", fails)
    given = tiny.CONFIG, [tiny.sphere_on_plane(1200, 0)], tmp_path, fit.Intervals()
    with pytest.raises(InputError, match=r"^step 0 has no points left"):
        fit.fit(*given, lambda *_: None)
    assert len(closed) == 1


def test_progress_leaves_skipped_steps_out():
    nan, history = float("nan"), [9.0, 1.0, float("nan"), 3.0, float("inf")]
    assert fit.recent_loss(history, 4) == 2.0
    assert np.isnan(fit.recent_loss([nan, nan], 2))

"""Training goes on whatever is in the data, and after whatever ends it.

Run as a script it trains into a folder, resuming what it finds there, and at a moment
that is asked for it kills itself as the kernel would: SIGKILL, no handler, no flush.
"""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny

from ginn_jax import checkpoint, dataset, fit, room, run_record
from ginn_jax.errors import InputError
from ginn_jax.presets import only_2d
from ginn_jax.searches import uniform_limits
from ginn_jax.train import StepReport, TrainState, state_shapes

POINTS = 200
LIT = replace(tiny.ONE_LEVEL, lights=1, local=True)
CONFIG = replace(
    tiny.CONFIG, network=LIT, points=POINTS, queries=32, steps=12, batch_size=1
)
OFTEN = fit.Intervals(report=1, save=3)


def cloud(seed, light=1.0):
    """A small cloud under a light; its target is as bright as that."""
    made = tiny.sphere_on_plane(POINTS, seed)
    shine = np.broadcast_to(np.float32(light), POINTS).copy()
    return made._replace(target=made.target * shine, light=shine[:, None])


def stressful():
    """Six clouds that stay, each bad in its own way, and one that cannot be learned."""
    sun = np.ones(POINTS)
    sun[7] = 1e5
    heap, far, nan = cloud(2), cloud(4), cloud(5)
    heap.position[:] = heap.position[0]
    far.position[::9] *= 1e4
    nan.target[::2] = np.nan
    return [cloud(0), cloud(1, sun), heap, cloud(3, 0.0), far, nan]


def train(folder, clouds, resume=False, progress=lambda *_: None, weights=None):
    given = CONFIG, clouds, folder, OFTEN, progress, resume
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        return fit.fit(*given, weights=weights)


@partial(jax.jit, donate_argnums=0)
def light_step(state, batch):
    """A state that depends on all states and batches before it, like a real one."""
    key = jax.random.fold_in(jax.random.key(CONFIG.seed), state.step)
    pull = batch.target.mean() + jax.random.normal(key)
    optimizer = jax.tree.map(lambda leaf: leaf + 1, state.optimizer)
    pull += sum(leaf.mean() for leaf in jax.tree.leaves(optimizer))
    variables = jax.tree.map(lambda leaf: 0.9 * leaf + pull, state.variables)
    return TrainState(variables, optimizer, state.step + 1, state.skipped), pull


def stand_in(put=setattr):
    """A step and capacities that compile at once, where the run around is tested."""

    def step(config, limits, state, batch):
        state, loss = light_step(state, batch)
        return state, StepReport(loss, loss, True, 1, {})

    put(fit, "train_step", step)
    put(fit, "training_room", lambda *_: tiny.ONE_LEVEL_ROOM)


def test_weights_that_are_given_are_trained_on(tmp_path, monkeypatch):
    stand_in(monkeypatch.setattr)
    shapes = state_shapes(CONFIG).variables
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    found = train(tmp_path, [cloud(0)], weights=zeros).state.variables
    # The same is done to all of them, and all began alike.
    values = np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(found)])
    assert values[0] > 1
    np.testing.assert_array_equal(values, values[0])


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


# Killed and resumed


class Killer:
    """SIGKILL at the `moment`-th of the calls that a run makes of some functions."""

    def __init__(self, moment):
        self.left = moment

    def __call__(self, *_):
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    def around(self, owner, name, later=None):
        """Count calls of a function, before and after; or die so long after one."""
        function = getattr(owner, name)

        def passed(*args, **kwargs):
            if later is None:
                self()
            done = function(*args, **kwargs)
            threading.Timer(later, self).start() if later else self()
            return done

        setattr(owner, name, passed)


def main(folder, place, moment):
    """Train, to be killed at a place of the run's for the `moment`-th time there."""
    folder, killer = Path(folder), Killer(int(moment))
    if place == "files":
        for name in ("save_losses", "save_run", "save_state"):
            killer.around(fit, name)
    elif place == "rename":
        for name in ("rename", "replace"):
            killer.around(os, name)
    elif place.startswith("writing"):
        killer.around(fit, "save_state", float(place.removeprefix("writing")))

    stand_in()

    def told(step, loss=0.0, note=""):
        with open(folder / "log", "a") as log:
            log.write(f"{step}\n")
        if place == "step":
            killer()

    resume = (folder / run_record.RECORD).exists()
    told("begun")
    train(folder, [cloud(seed) for seed in range(3)], resume, told)


def launch(folder, place, moment):
    """Whether a run in another process came to its end."""
    folder.mkdir(exist_ok=True)
    here = Path(__file__).parent
    # Every life is a process, but they need not compile the same programs.
    programs = {"JAX_COMPILATION_CACHE_DIR": str(folder.parent / "programs")}
    programs |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    paths = [str(here), str(here.parent), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, __file__, folder, place, str(moment)],
        env=os.environ | programs | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode in (0, -signal.SIGKILL), done.stderr[-2000:]
    return done.returncode == 0


def check_log(folder):
    """No more was lost than the steps since the last two checkpoints began."""
    reached, starts = 0, []
    for line in (folder / "log").read_text().split():
        if not line.isdigit():
            fresh = True
            continue
        if fresh:
            assert (int(line) - 1) % OFTEN.save == 0
            assert int(line) > reached - 2 * OFTEN.save
            starts.append(int(line))
        reached, fresh = int(line), False
    assert reached == CONFIG.steps
    assert starts == sorted(starts)
    assert starts[-1] > OFTEN.save


@pytest.fixture(scope="module")
def unbroken(tmp_path_factory):
    """A run that nothing disturbed, in a process of its own."""
    folder = tmp_path_factory.mktemp("runs") / "unbroken"
    assert launch(folder, "nowhere", 1)
    return folder


# One at random; then before a life's first checkpoint; while the second is written
# and the first is whole; with losses beyond the checkpoint; after steps that none has.
RANDOM = random.Random(6)
MOMENTS = [(RANDOM.choice(("step", "files", "rename")), RANDOM.randint(1, 5))]
MOMENTS += [("rename", 3), ("writing.002", 2), ("files", 8), ("step", 8)]


def check_killed(folder, unbroken, moments):
    """Killed at each moment, then left alone: the very run that was never killed."""
    killed = [not launch(folder, place, moment) for place, moment in moments]
    assert all(killed), killed
    assert launch(folder, "nowhere", 1)
    check_log(folder)
    found, wanted = (checkpoint.load_weights(f) for f in (folder, unbroken))
    assert tiny.identical(found[2], wanted[2])
    losses = [fit.load_losses(f, CONFIG.steps) for f in (folder, unbroken)]
    np.testing.assert_array_equal(*losses)
    assert not list((folder / checkpoint.CHECKPOINTS).glob("*tmp*"))


def test_killed_run_ends_as_an_unbroken_one(unbroken):
    check_killed(unbroken.parent / "killed", unbroken, MOMENTS)


def test_time_spent_before_counts(unbroken):
    folder = unbroken.parent / "earlier"
    shutil.copytree(unbroken, folder)
    path = folder / run_record.RECORD
    record = json.loads(path.read_text())
    assert record["seconds"]["train"] > 0
    path.write_text(json.dumps(record | {"seconds": {"compile": 1e6, "train": 2e6}}))
    found = train(folder, [cloud(seed) for seed in range(3)], True)
    assert found.seconds["train"] == 2e6
    assert found.seconds["compile"] > 1e6


def test_part_of_a_checkpoint_is_ignored_or_named(unbroken):
    """Half a checkpoint under a temporary name is nothing; under its own it is told."""
    folder = unbroken.parent / "half"
    shutil.copytree(unbroken, folder)
    newest = folder / checkpoint.CHECKPOINTS / str(CONFIG.steps)
    shutil.copytree(newest, newest.with_name("99.orbax-checkpoint-tmp"))
    assert tiny.identical(*(checkpoint.load_weights(f)[2] for f in (folder, unbroken)))
    for file in sorted(p for p in newest.rglob("*") if p.is_file())[::2]:
        file.unlink()
    with pytest.raises(InputError, match=rf"^checkpoint {newest} [^\n]*\Z"):
        checkpoint.load_weights(folder)


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
    limits = uniform_limits(network, 1 << 15)
    ample = room.Room(limits, limits)
    monkeypatch.setattr(fit, "training_room", lambda *_: ample)
    clouds = [tiny.sphere_on_plane(n, i) for i, n in enumerate(sizes)]
    config = replace(tiny.CONFIG, network=network, steps=3)
    optax = jax.numpy_dtype_promotion("standard")
    refused = pytest.raises(InputError, match=message)
    with tiny.cheap_compiling(), optax, refused:
        fit.fit(config, clouds, tmp_path, fit.Intervals(), lambda *_: None)


def test_progress_leaves_skipped_steps_out():
    nan, history = float("nan"), [9.0, 1.0, float("nan"), 3.0, float("inf")]
    assert fit.recent_loss(history, 4) == 2.0
    assert np.isnan(fit.recent_loss([nan, nan], 2))


if __name__ == "__main__":
    main(*sys.argv[1:])

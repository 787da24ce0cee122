"""A run that is killed ends as one that is not, whenever that is.

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
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny
from short_run import CONFIG, OFTEN, cloud, train

from ginn_jax import checkpoint, fit, run_record
from ginn_jax.errors import InputError
from ginn_jax.train import StepReport, TrainState, state_shapes


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


def test_no_record_stands_beside_the_checkpoints_of_another_run(tmp_path, monkeypatch):
    """A run that begins anew is stopped while it removes those of the one before."""
    stand_in(monkeypatch.setattr)
    train(tmp_path, [cloud(0)], spent={"data": 5.0})
    before = json.loads((tmp_path / run_record.RECORD).read_text())
    assert before["seconds"]["data"] == 5

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(checkpoint.shutil, "rmtree", stop)
    with pytest.raises(KeyboardInterrupt):
        train(tmp_path, [cloud(0)], spent={"data": 6.0})
    assert json.loads((tmp_path / run_record.RECORD).read_text()) == before


def test_the_last_state_is_saved_whatever_the_interval(tmp_path, monkeypatch):
    stand_in(monkeypatch.setattr)
    monkeypatch.setattr("short_run.OFTEN", fit.Intervals(report=1, save=5))
    found = train(tmp_path, [cloud(0)])
    saved = checkpoint.load_weights(tmp_path)[2]
    assert tiny.identical(saved, jax.device_get(found.state.variables))
    assert np.isfinite(fit.load_losses(tmp_path, CONFIG.steps)).all()


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
    paths = [str(here), str(here.parent), os.environ.get("PYTHONPATH", "")]
    done = subprocess.run(
        [sys.executable, __file__, folder, place, str(moment)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
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
    spent = {"compile": 1e6, "train": 2e6, "data": 3e6}
    path.write_text(json.dumps(record | {"seconds": spent}))
    clouds = [cloud(seed) for seed in range(3)]
    found = train(folder, clouds, True, spent={"data": 10.0})
    assert found.seconds["train"] == 2e6
    assert found.seconds["compile"] > 1e6
    assert found.seconds["data"] == 3e6 + 10


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


if __name__ == "__main__":
    main(*sys.argv[1:])

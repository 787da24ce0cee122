"""Clouds, runs and checkpoints that cannot be used.

`ROWS` is the table: what is wrong, how to make it, what is called with it, and what is
said.
"""

import json
import os

import jax.numpy as jnp
import numpy as np
import tiny
from damaged import Row, assert_refused, directory, each_row, missing, zeros
from saved import STATE, restore, save_state

from ginn_jax import checkpoint, dataset, lit_clouds, run_record

LIT, GREY = lit_clouds.load_lit_cloud, dataset.load_cloud


def shard(change=lambda whole: whole, **columns):
    """A cloud's file, its bytes or some of its columns changed."""

    def make(folder):
        cloud = tiny.sphere_on_plane(20, 0)._asdict() | columns
        arrays = {name: a for name, a in cloud.items() if a is not None}
        dataset.save_arrays(folder / "shard.npz", arrays, {})
        path = folder / "shard.npz"
        path.write_bytes(change(path.read_bytes()))
        return path

    return make


def pickled(folder):
    """A cloud with a column of objects, which only a pickle can hold."""
    objects = np.array([os.getcwd], object)
    np.savez(folder / "shard.npz", origin="{}", position=objects, allow_pickle=True)
    return folder / "shard.npz"


def run(record=None, text=None, damage=None):
    """The folder of a run with this record and a checkpoint."""

    def make(folder):
        run_record.save_run(folder, tiny.CONFIG, tiny.ROOM, {})
        saved = json.loads((folder / "run.json").read_text()) | (record or {})
        content = json.dumps(saved) if text is None else text
        (folder / "run.json").write_text(content)
        save_state(folder)
        if damage is not None:
            damage(folder)
        return folder

    return make


def restore_wider(folder):
    wider = {"encoder": {"kernel": jnp.ones((3, 5))}, "shader": {}}
    return restore(folder, STATE._replace(variables=wider))


def halve_checkpoint(folder):
    for path in (folder / "checkpoints" / "3").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def resume(folder):
    return run_record.load_run(folder, tiny.CONFIG, {})


def with_training(**change):
    """A record whose training says something else."""

    def make(folder):
        run()(folder)
        record = json.loads((folder / "run.json").read_text())
        record["training"] |= change
        (folder / "run.json").write_text(json.dumps(record))
        return folder

    return make


ROWS = [
    # Clouds on disk
    Row("no shard", missing("a.npz"), GREY, "no such file"),
    Row("half a shard", shard(lambda b: b[: len(b) // 2]), GREY, "damaged: delete it"),
    Row("1 GB shard of nothing", zeros("a.npz"), GREY, "damaged: delete it"),
    Row("shard with a pickle", pickled, GREY, "damaged: delete it"),
    Row("lit: pickle", pickled, LIT, "damaged: delete it"),
    Row("shard is a folder", directory("a.npz"), GREY, "Is a directory.*: mend that"),
    Row(
        "of 2D points", shard(position=np.ones((20, 2))), GREY, "another kind of cloud"
    ),
    Row("of unequal rows", shard(target=np.ones(19)), GREY, "another kind of cloud"),
    Row("of words", shard(target=np.array(["a"] * 20)), GREY, "another kind of cloud"),
    Row("without target", shard(target=None), GREY, "another kind of cloud"),
    Row("grey as lit", shard(), LIT, "another kind of cloud: choose another"),
    # Runs and checkpoints
    Row("no run", directory("r"), checkpoint.load_weights, "no run: name the --out"),
    Row("no run to resume", directory("r"), resume, "no run to resume: leave out"),
    Row("half a record", run(text='{"training'), resume, "damaged: delete it"),
    Row("record of nothing", run(text="\0" * 99), resume, "damaged: delete it"),
    Row("deep record", run(text='{"a":' * 10**5), resume, "damaged: delete it"),
    Row(
        "record, limit inf",
        run({"limits": {"a": np.inf}}),
        resume,
        "damaged: delete it",
    ),
    Row("record, limit -1", run({"limits": {"a": -1}}), resume, "damaged: delete it"),
    *(
        Row(
            f"record, {n} {v}",
            with_training(**{n: v}),
            checkpoint.load_weights,
            "damaged: train again",
        )
        for n, v in (("steps", 0), ("points", "many"), ("network", {"levels": []}))
    ),
    Row(
        "checkpoint of another shape",
        run(),
        restore_wider,
        "not of this network: .*encoder.kernel",
    ),
    Row("half a checkpoint", run(damage=halve_checkpoint), restore, "3 cannot be read"),
    Row("weights of another shape", run(), checkpoint.load_weights, "cannot be read"),
]


@each_row(ROWS)
def test_bad_file_is_refused_in_one_line(row, tmp_path):
    assert_refused(row, tmp_path)

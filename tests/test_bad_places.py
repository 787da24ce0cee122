"""Disks that are full or forbidden, scripts that fail, files that would run code.

Who typed a command sees no traceback: one line, and 2 for their mistakes, 1 for ours.
"""

import os
import pickle
import re
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import trimesh
from damaged import contents, refused
from saved import STATE, restore, save_state

from benchmarks import neighbors, scaling
from experiments import animation, ao_train, evaluate, gi_train
from ginn_jax import (
    checkpoint,
    commandline,
    dataset,
    fit,
    lighting,
    mesh,
    run_record,
    samples,
)
from ginn_jax.errors import InputError

NOBODY = 65534
ROOT = Path(__file__).parents[1]


@contextmanager
def full_disk(limit=256):
    """No file can grow beyond `limit` bytes, as where that is all the room left."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@contextmanager
def no_permission(folder):
    """Nothing may be read or written in a folder, not even by root."""
    folder.chmod(0)
    root = os.geteuid() == 0
    try:
        if root:
            os.seteuid(NOBODY)
        yield
    finally:
        if root:
            os.seteuid(0)
        folder.chmod(0o700)


def save_cloud(folder):
    dataset.save_cloud(folder / "a.npz", tiny.sphere_on_plane(50, 0), {})


def save_record(folder):
    run_record.save_run(folder, tiny.CONFIG, tiny.ROOM, {})


def save_losses(folder):
    fit.save_losses(folder, [0.5] * 100)


def save_large_state(folder):
    kernel = np.random.default_rng(0).normal(size=(200, 200))
    save_state(folder, STATE._replace(variables={"encoder": jnp.array(kernel)}))


WRITERS = [save_cloud, save_record, save_losses]


@pytest.mark.parametrize("writer", WRITERS)
def test_full_disk_leaves_what_was_there(writer, tmp_path):
    writer(tmp_path)
    with full_disk():
        said = refused(lambda: writer(tmp_path), tmp_path, r"too large\): make room")
    assert str(tmp_path) in said


@pytest.mark.parametrize("writer", WRITERS)
def test_writing_without_permission_is_refused(writer, tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    with no_permission(inner), pytest.raises(InputError, match="Permission denied"):
        writer(inner)
    assert not contents(tmp_path)


@pytest.mark.parametrize("writer", WRITERS)
def test_writing_into_a_file_is_refused(writer, tmp_path):
    (tmp_path / "file").write_text("mine")
    refused(lambda: writer(tmp_path / "file"), tmp_path, "Not a directory.*make room")


def test_full_disk_leaves_no_checkpoint(tmp_path):
    with (
        full_disk(4096),
        pytest.raises(InputError, match="cannot be") as caught,
    ):
        save_large_state(tmp_path)
    assert str(caught.value).isprintable()
    assert restore(tmp_path) is None
    save_state(tmp_path)
    assert restore(tmp_path).step == 3


@pytest.mark.parametrize(
    ("name", "call"),
    [
        ("a.ply", mesh.load_mesh),
        ("a.ply", samples.load_points),
        ("a.hdr", lighting.load_environment),
        ("a.npz", dataset.load_cloud),
        ("", checkpoint.load_weights),
    ],
)
def test_reading_without_permission_is_refused(name, call, tmp_path):
    inner = tmp_path / "inner"
    inner.mkdir()
    trimesh.creation.box().export(inner / "a.ply")
    with (
        no_permission(inner),
        pytest.raises(InputError, match="Permission") as said,
    ):
        call(inner / name)
    assert str(inner) in str(said.value)


# Nothing is executed


class Trap:
    """Who unpickles this is caught."""

    def __reduce__(self):
        return (open, ("/nowhere/unpickled", "w"))


def test_loading_unpickles_nothing(tmp_path, monkeypatch):
    (tmp_path / "run").mkdir()
    save_state(tmp_path / "run")
    save_losses(tmp_path / "run")
    save_cloud(tmp_path)
    trap = pickle.dumps(Trap())
    for name in ("a.ply", "a.obj", "a.stl", "a.glb", "bad.npz", "a.hdr"):
        (tmp_path / name).write_bytes(trap)
    np.savez(tmp_path / "b.npz", origin="{}", position=np.array([Trap()], object))
    asked, load = [], np.load

    def spy(*given, **options):
        asked.append(options.get("allow_pickle", False))
        return load(*given, **options)

    def refuse(*_, **__):
        raise AssertionError("something was unpickled")

    monkeypatch.setattr(np, "load", spy)
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, refuse)
    assert restore(tmp_path / "run").step == 3
    assert fit.load_losses(tmp_path / "run", 100).tolist() == [0.5] * 100
    assert len(dataset.load_cloud(tmp_path / "a.npz").position) == 50
    for name in ("bad.npz", "b.npz"):
        with pytest.raises(InputError, match="damaged"):
            dataset.load_cloud(tmp_path / name)
    for name in ("a.ply", "a.obj", "a.stl", "a.glb"):
        with pytest.raises(InputError):
            mesh.load_mesh(tmp_path / name)
    with pytest.raises(InputError):
        lighting.load_environment(tmp_path / "a.hdr")
    assert len(asked) >= 4
    assert not any(asked)


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", b"\x80\x04K\x01."])
def test_losses_that_cannot_be_read_are_unknown(content, tmp_path):
    (tmp_path / "losses.npy").write_bytes(content)
    assert np.isnan(fit.load_losses(tmp_path, 3)).all()


# Scripts


def ends(monkeypatch, capsys, script, *words, main=None):
    """The exit code of a script and the one line that it ends in."""
    monkeypatch.setattr(sys, "argv", ["script", *map(str, words)])
    for name in ("tune_process", "silence_threads"):
        monkeypatch.setattr(commandline, name, lambda: None)
    with pytest.raises(SystemExit) as stopped:
        commandline.start(script.Options, main or script.main, {})
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    return stopped.value.code, lines[0]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--steps", "0"), "--steps is 0: give at least 1"),
        (("--steps", "-3"), "--steps is -3: give at least 1"),
        (("--points", 10**13), "--points is 10000000000000: give at most"),
        (("--steps", "1.5"), "--steps"),
        (("--steps", "many"), "--steps"),
        (("--seed", "-1"), "--seed is -1"),
        (("--seed", "100"), "--seed 100"),
        (("--learning-rate", "nan"), "--learning-rate is nan: give it above 0"),
        (("--resolution-scale", "0"), r"resolution scale 0\.0: give 1 over"),
        (("--preset", "none"), "--preset"),
        (("--no-such-option",), "no-such-option"),
        (("--test-meshes", "gone"), "gone: no such file or folder"),
    ],
)
@pytest.mark.parametrize("script", [ao_train, gi_train], ids=["ao", "gi"])
def test_mistakes_in_options_end_in_code_2(
    script, words, message, tmp_path, monkeypatch, capsys
):
    words = ("--out", tmp_path / "out", *words)
    code, line = ends(monkeypatch, capsys, script, *words)
    assert code == 2
    assert re.search(message, line)
    assert not contents(tmp_path)


SEVERAL = [
    (evaluate, ("--counts", "4", "0"), "--counts is 0: give at least 1"),
    (evaluate, ("--fewer-looks", "0"), "--fewer-looks is 0: give at least 1"),
    (evaluate, ("--disks", "1.5", "inf"), "--disks is inf: give it above 0"),
    (animation, ("--disks", "-1"), "--disks is -1.0: give it above 0"),
    (neighbors, ("--radii", ".1", "0"), "--radii is 0.0: give it above 0"),
    (scaling, ("--points", "1000", "-4"), "--points is -4: give at least 100"),
]


@pytest.mark.parametrize(("script", "words", "message"), SEVERAL)
def test_each_of_several_values_is_looked_at(
    script, words, message, tmp_path, monkeypatch, capsys
):
    words = ("--out", tmp_path / "out", *words)
    code, line = ends(monkeypatch, capsys, script, *words)
    assert code == 2
    assert message in line
    assert not contents(tmp_path)


def raising(error):
    def main(_):
        raise error

    return main


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (InputError("a: bad\nb"), 2, "error: a: bad b"),
        (
            OSError(28, "No space left on device", "x/y"),
            2,
            "x/y: No space left on device",
        ),
        (PermissionError(13, "Permission denied", "x"), 2, "x: Permission denied"),
        (MemoryError("Unable to allocate 9 TiB"), 2, "not enough memory"),
        (KeyboardInterrupt(), 130, "stopped"),
        (
            ZeroDivisionError("two\nlines"),
            1,
            "ours, ZeroDivisionError at test_bad_places",
        ),
        (OSError("no number"), 1, "a mistake of ours, OSError"),
        (AssertionError(), 1, "a mistake of ours, AssertionError"),
    ],
)
def test_what_ends_a_script_is_one_line(error, code, message, monkeypatch, capsys):
    found = ends(monkeypatch, capsys, ao_train, main=raising(error))
    assert found[0] == code
    assert message in found[1]


def test_our_mistakes_show_their_traceback_when_asked(monkeypatch):
    monkeypatch.setenv("GINN_JAX_TRACEBACK", "1")
    monkeypatch.setattr(sys, "argv", ["script"])
    for name in ("tune_process", "silence_threads"):
        monkeypatch.setattr(commandline, name, lambda: None)
    with pytest.raises(ZeroDivisionError):
        commandline.start(ao_train.Options, raising(ZeroDivisionError()), {})


def test_a_folder_that_is_a_file_ends_in_one_line_and_code_2(tmp_path):
    (tmp_path / "file").write_text("mine")
    words = ("--out", str(tmp_path / "file"), "--shapes", "1", "--points", "1000")
    said = subprocess.run(
        [sys.executable, "-m", "experiments.gi_train", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert said.returncode == 2
    assert len(said.stderr.strip().splitlines()) == 1
    assert str(tmp_path / "file") in said.stderr
    assert (tmp_path / "file").read_text() == "mine"

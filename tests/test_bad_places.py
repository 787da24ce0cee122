"""Disks that are full or forbidden, files that would run code."""

import os
import pickle
import resource
from contextlib import contextmanager

import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import trimesh
from damaged import contents, refused
from saved import STATE, restore, save_state

from ginn_jax import (
    checkpoint,
    dataset,
    fit,
    lighting,
    mesh,
    run_record,
    samples,
)
from ginn_jax.errors import InputError

NOBODY = 65534


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

"""Files that cannot be used: each refused in one line that names it and the mend.

`ROWS` is the table: what is wrong, how to make it, what is called with it, and what is
said. Nothing may be written, and nothing that was there may change.
"""

import json
import os
import resource
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import trimesh

from ginn_jax import checkpoint, dataset, lighting, lit_clouds, mesh
from ginn_jax.errors import InputError
from ginn_jax.renderer import use_mitsuba
from ginn_jax.train import TrainState

GIGABYTE = 1 << 30
NOISE = np.random.default_rng(0).bytes(3000)
BOX = trimesh.creation.box()
PLY, TEXT_PLY = (BOX.export(file_type="ply", encoding=e) for e in ("binary", "ascii"))
STL = BOX.export(file_type="stl")
TRIANGLE = "v {} 0 0\nv 1 0 0\nv 0 1 0\nf {} 2 3\n"
POINTS = "ply\nformat ascii 1.0\nelement vertex {}\n" + "".join(
    f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz")
)
ONE_POINT = POINTS + "end_header\n0 0 0 0 1 0\n"
STATE = TrainState(
    {"encoder": {"kernel": jnp.ones((3, 4))}, "shader": {}},
    (),
    jnp.int32(3),
    jnp.int32(0),
)


def holds(content, name="bad"):
    """A file of these bytes."""

    def make(folder):
        path = folder / name
        path.write_bytes(content.encode() if isinstance(content, str) else content)
        return path

    return make


def zeros(name):
    """A gigabyte of nothing."""

    def make(folder):
        with open(folder / name, "wb") as file:
            file.truncate(GIGABYTE)
        return folder / name

    return make


def directory(name):
    def make(folder):
        (folder / name).mkdir()
        return folder / name

    return make


def missing(name):
    return lambda folder: folder / name


def image(name, value):
    """A map with one pixel of this value."""

    def make(folder):
        pixels = np.ones((4, 8, 3), np.float32)
        pixels[1, 2, 0] = value
        use_mitsuba()[0].Bitmap(pixels).write(str(folder / name))
        return folder / name

    return make


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
        checkpoint.save_run(folder, tiny.CONFIG, tiny.LIMITS, {})
        saved = json.loads((folder / "run.json").read_text()) | (record or {})
        content = json.dumps(saved) if text is None else text
        (folder / "run.json").write_text(content)
        save_state(folder)
        if damage is not None:
            damage(folder)
        return folder

    return make


def save_state(folder, state=STATE):
    manager = checkpoint.open_manager(folder)
    checkpoint.save_state(manager, state)
    checkpoint.finish(manager)


def restore(folder, like=STATE):
    manager = checkpoint.open_manager(folder)
    try:
        return checkpoint.restore_state(manager, like)
    finally:
        manager.close()


def restore_wider(folder):
    wider = {"encoder": {"kernel": jnp.ones((3, 5))}, "shader": {}}
    return restore(folder, STATE._replace(variables=wider))


def halve_checkpoint(folder):
    for path in (folder / "checkpoints" / "3").rglob("*"):
        if path.is_file():
            path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def resume(folder):
    return checkpoint.load_run(folder, tiny.CONFIG, {})


def huge(header):
    """A map that says it is enormous."""
    return header.encode() + NOISE


def with_training(**change):
    """A record whose training says something else."""

    def make(folder):
        run()(folder)
        record = json.loads((folder / "run.json").read_text())
        record["training"] |= change
        (folder / "run.json").write_text(json.dumps(record))
        return folder

    return make


class Row(NamedTuple):
    """What is wrong, how to make it, what is called with it, what is said."""

    name: str
    make: Any
    call: Any
    message: str


LIT, GREY, MAP = (
    lit_clouds.load_lit_cloud,
    dataset.load_cloud,
    lighting.load_environment,
)
RGBE = "#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {0} +X {0}\n"
ROWS = [
    # Meshes
    Row("no file", missing("a.ply"), mesh.load_mesh, "no such file; give the path"),
    Row("a folder", directory("a.ply"), mesh.load_mesh, "no such file; give the path"),
    Row("long name", missing("a" * 300), mesh.load_mesh, "name too long; give the"),
    Row("line break in its name", missing("a\nb"), mesh.load_mesh, "a b: no such file"),
    Row("empty PLY", holds("", "a.ply"), mesh.load_mesh, "nothing in it"),
    *(
        Row(f"1 GB of nothing, {name}", zeros(name), call, "nothing in it")
        for name, call in (
            ("a.ply", mesh.load_mesh),
            ("a.obj", mesh.load_mesh),
            ("a.stl", mesh.load_mesh),
            ("a.glb", mesh.load_mesh),
            ("p.ply", mesh.load_points),
            ("a.hdr", MAP),
            ("a.exr", MAP),
        )
    ),
    Row("half a PLY", holds(PLY[:300], "a.ply"), mesh.load_mesh, "unexpected length"),
    Row("PLY without end", holds(PLY[:100], "a.ply"), mesh.load_mesh, "export it anew"),
    Row("half a text PLY", holds(TEXT_PLY[:-30], "a.ply"), mesh.load_mesh, "cut short"),
    Row("half an STL", holds(STL[:200], "a.stl"), mesh.load_mesh, "no triangles in it"),
    Row(
        "a PLY of 10^12 vertices",
        holds(PLY.replace(b"vertex 8", b"vertex 1000000000000"), "a.ply"),
        mesh.load_mesh,
        "unexpected length",
    ),
    *(
        Row(f"noise.{end}", holds(NOISE, f"a.{end}"), mesh.load_mesh, said)
        for end, said in (
            ("ply", "Not a ply"),
            ("obj", "no triangles in it"),
            ("stl", "no triangles in it"),
            ("off", "cannot be read"),
            ("glb", "incorrect header"),
            ("gltf", "cannot be read"),
            ("txt", "'txt' not supported"),
            ("npz", "'npz' not supported"),
        )
    ),
    Row("PLY as OBJ", holds(PLY, "a.obj"), mesh.load_mesh, "no triangles in it"),
    Row("OBJ as PLY", holds(TRIANGLE, "a.ply"), mesh.load_mesh, "Not a ply"),
    Row(
        "no faces",
        holds("v 0 0 0\nv 1 0 0\n", "a.obj"),
        mesh.load_mesh,
        "use load_points",
    ),
    Row("no geometry", holds("{}", "a.gltf"), mesh.load_mesh, "no triangles in it"),
    *(
        Row(f"OBJ, {name}", holds(TRIANGLE.format(*v), "a.obj"), mesh.load_mesh, said)
        for name, v, said in (
            ("vertex NaN", ("nan", 1), "1 vertices are not finite; remove them"),
            ("vertex 1e39", ("1e39", 1), "1 vertices are not finite; remove them"),
            ("vertex word", ("word", 1), "cannot be read"),
            ("face 9", ("0", 9), "index 8 is out of bounds"),
            ("face 2 2 3", ("0", 2), "zero area; give triangles with an area"),
        )
    ),
    Row("no meshes", directory("none"), mesh.find_meshes, "no mesh in this folder"),
    Row("no folder", missing("gone"), mesh.find_meshes, "no such file or folder"),
    # Points
    Row("no rows", holds(POINTS.format(0), "p.ply"), mesh.load_points, "export|save"),
    Row("5 rows, 1 there", holds(ONE_POINT.format(5), "p.ply"), mesh.load_points, "cu"),
    Row(
        "no normals",
        holds(ONE_POINT.format(1).replace(" nx", " a"), "p.ply"),
        mesh.load_points,
        "no normals; estimate them",
    ),
    Row(
        "zero normal",
        holds(ONE_POINT.format(1).replace("0 1 0\n", "0 0 0\n"), "p.ply"),
        mesh.load_points,
        "zero normal; drop them",
    ),
    Row("a mesh", holds(PLY, "p.ply"), mesh.load_points, "a mesh, .* use load_mesh"),
    # Environment maps
    Row("no HDR", missing("a.hdr"), MAP, "no such file; give an environment map"),
    Row("no maps", directory("none"), lighting.find_environments, "no .hdr, .exr"),
    *(
        Row(f"{name} of {value}", image(name, value), MAP, said)
        for name in ("a.exr", "a.pfm")
        for value, said in (
            (np.nan, "not finite; mend those pixels"),
            (np.inf, "not finite; mend those pixels"),
            (-1.0, "negative; clip it at zero"),
        )
    ),
    Row("noise.hdr", holds(NOISE, "a.hdr"), MAP, "Unknown file format"),
    Row("PLY as HDR", holds(PLY, "a.hdr"), MAP, "Unknown file format"),
    Row(
        "enormous HDR", holds(huge(RGBE.format(10**6)), "a.hdr"), MAP, "cannot be read"
    ),
    Row("HDR of -8 rows", holds(huge(RGBE.format(-8)), "a.hdr"), MAP, "cannot be read"),
    Row("enormous PFM", holds(huge("PF\n999999 999999\n-1\n"), "a.pfm"), MAP, "cannot"),
    # Clouds on disk
    Row("no shard", missing("a.npz"), GREY, "no such cloud"),
    Row("half a shard", shard(lambda b: b[: len(b) // 2]), GREY, "damaged: delete it"),
    Row("1 GB shard of nothing", zeros("a.npz"), GREY, "damaged: delete it"),
    Row("shard with a pickle", pickled, GREY, "damaged: delete it"),
    Row("lit: pickle", pickled, LIT, "damaged: delete it"),
    Row("shard is a folder", directory("a.npz"), GREY, "Is a directory.*: mend that"),
    Row("of 2D points", shard(position=np.ones((20, 2))), GREY, "another kind"),
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
    Row("record, limit inf", run({"limits": {"a": np.inf}}), resume, "damaged: delete"),
    Row("record, limit -1", run({"limits": {"a": -1}}), resume, "damaged: delete"),
    *(
        Row(f"record, {n} {v}", with_training(**{n: v}), checkpoint.load_weights, "dam")
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


def contents(folder):
    """Every path below a folder, and how large it is."""
    return {str(p): p.stat().st_size for p in folder.rglob("*") if not p.is_dir()}


def refused(call, folder, message):
    """The one line that a call ends in, having left the folder as it was."""
    before = contents(folder)
    with pytest.raises(InputError, match=message) as caught:
        call()
    assert str(caught.value).isprintable()
    assert contents(folder) == before
    return str(caught.value)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_bad_file_is_refused_in_one_line(row, tmp_path):
    path = row.make(tmp_path)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    said = refused(lambda: row.call(path), tmp_path, row.message)
    assert "".join(c if c.isprintable() else " " for c in str(path)) in said
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak
    assert grown * 1024 < GIGABYTE / 2

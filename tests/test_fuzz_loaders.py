"""Whatever bytes a loader is given: it returns what it promises or `InputError`."""

import json
import warnings
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
import tiny
from damaged import BOX
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from saved import restore, save_state
from test_bad_files import ONE_POINT

from ginn_jax import (
    checkpoint,
    dataset,
    lighting,
    lit_clouds,
    mesh,
    run_record,
    samples,
)
from ginn_jax.errors import InputError, InputWarning
from ginn_jax.renderer import use_mitsuba

MANY = settings(
    max_examples=60, suppress_health_check=[HealthCheck.too_slow], deadline=None
)
# Numbers that headers hold, and others that they had better not.
NUMBERS = st.sampled_from(
    [b"0", b"-1", b"9" * 12, b"nan", b"1e999", b'"', b"[", b"\xff"]
)


@cache
def written(name):
    """The bytes of a good file of this name."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        kind = path.suffix[1:]
        if name.startswith("cloud"):
            dataset.save_cloud(path, tiny.sphere_on_plane(20, 0), {"seed": 1})
        elif name.startswith("lit"):
            lit_clouds.save_lit_cloud(path, lit_cloud(), {"seed": 1})
        elif name == "run.json":
            run_record.save_run(path.parent, tiny.CONFIG, tiny.ROOM, {"seed": 1})
        elif kind in ("hdr", "exr", "pfm"):
            pixels = np.random.default_rng(0).uniform(size=(4, 8, 3))
            use_mitsuba()[0].Bitmap(pixels.astype(np.float32)).write(str(path))
        elif name.startswith("points"):
            path.write_text(ONE_POINT.format(3) + "1 0 0 0 1 0\n0 0 1 1 0 0\n")
        elif name == "text.ply":
            path.write_bytes(BOX.export(None, "ply", encoding="ascii"))
        else:
            BOX.export(path)
        return path.read_bytes()


def lit_cloud():
    points = tiny.sphere_on_plane(20, 0)
    light = np.random.default_rng(0).uniform(size=(3, 20, 3)).astype(np.float32)
    materials, albedo = np.arange(20, dtype=np.int32) % 2, np.full((2, 3), 0.5)
    return lit_clouds.LitCloud(*points[:2], materials, *light, albedo, np.zeros(0))


@st.composite
def spoiled(draw, whole):
    """A good file cut, with bytes flipped, put in or overwritten; or just any bytes."""
    kind = draw(st.sampled_from(["any", "head", "cut", "flip", "insert", "number"]))
    if kind == "any":
        return draw(st.binary(max_size=400))
    place = draw(st.integers(0, len(whole) - 1))
    if kind == "head":
        return whole[:place] + draw(st.binary(max_size=100))
    if kind == "cut":
        return whole[:place]
    if kind == "insert":
        return whole[:place] + draw(st.binary(min_size=1, max_size=9)) + whole[place:]
    if kind == "number":
        new = draw(NUMBERS)
        return whole[:place] + new + whole[place + draw(st.integers(0, 9)) :]
    flipped = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        flipped[draw(st.integers(0, len(whole) - 1))] ^= draw(st.integers(1, 255))
    return bytes(flipped)


def said_well(error, folder):
    """None; what was said is one line that names the place."""
    assert str(error).isprintable()
    assert folder in str(error)


def load(call, name, content):
    """What a loader returns of a file, or None if it refuses it in one line."""
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        path = Path(folder) / name
        path.write_bytes(content)
        try:
            return call(path.parent if name == "run.json" else path)
        except InputError as error:
            return said_well(error, folder)
        finally:
            assert [p.name for p in Path(folder).iterdir()] == [name]


@pytest.mark.parametrize(
    "name", ["a.ply", "text.ply", "a.obj", "a.stl", "a.off", "a.glb", "a.xyz"]
)
@MANY
@given(st.data())
def test_any_mesh_file_is_a_mesh_or_refused(name, data):
    good = written(name if name != "a.xyz" else "a.off")
    found = load(mesh.load_mesh, name, data.draw(spoiled(good)))
    if found is not None:
        mesh.check_mesh(found)
        assert np.isfinite(found.vertices).all()


@MANY
@given(st.data())
def test_any_point_file_is_points_or_refused(data):
    found = load(
        samples.load_points, "points.ply", data.draw(spoiled(written("points.ply")))
    )
    if found is not None:
        assert np.isfinite(found.position).all()
        np.testing.assert_allclose(np.linalg.norm(found.normal, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("name", ["a.hdr", "a.exr", "a.pfm"])
@MANY
@given(st.data())
def test_any_image_is_a_map_or_refused(name, data):
    found = load(lighting.load_environment, name, data.draw(spoiled(written(name))))
    if found is not None:
        lighting.check_light(found)
        assert found.radiance.max() > 0


@pytest.mark.parametrize(
    ("name", "call"),
    [("cloud.npz", dataset.load_cloud), ("lit.npz", lit_clouds.load_lit_cloud)],
)
@MANY
@given(st.data())
def test_any_archive_is_a_cloud_or_refused(name, call, data):
    found = load(call, name, data.draw(spoiled(written(name))))
    if found is not None:
        assert found.position.shape == found.normal.shape
        assert len(found.target) == len(found.position)


@pytest.mark.parametrize("how", ["resume", "weights"])
@MANY
@given(st.data())
def test_any_record_is_a_run_or_refused(how, data):
    def resume(folder):
        return run_record.load_run(folder, tiny.CONFIG, {"seed": 1})

    call = resume if how == "resume" else checkpoint.load_weights
    found = load(call, "run.json", data.draw(spoiled(written("run.json"))))
    if found is not None:
        # A digit may be another: still a run, of the same stages, that fits or retries.
        for limits in found[0].each() if how == "resume" else [found[1]]:
            assert {name for name, _ in limits.sizes} == set(dict(tiny.LIMITS.sizes))
            assert all(size > 0 for _, size in limits.sizes)


@MANY
@given(st.data())
def test_any_record_of_json_is_a_run_or_refused(data):
    """JSON all right, one of its values another."""
    record = json.loads(written("run.json"))
    part = record
    while isinstance(part, dict | list) and part:
        inner, keys = part, list(part) if isinstance(part, dict) else range(len(part))
        key = data.draw(st.sampled_from(list(keys)))
        part = part[key]
        if data.draw(st.booleans()):
            break
    leaves = (
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=9)
    )
    inner[key] = data.draw(st.recursive(leaves, st.lists, max_leaves=4))
    found = load(checkpoint.load_weights, "run.json", json.dumps(record).encode())
    assert found is None  # there is no checkpoint


@cache
def saved():
    """The files of a good checkpoint."""
    with TemporaryDirectory() as folder:
        save_state(Path(folder))
        files = sorted(p for p in Path(folder).rglob("*") if p.is_file())
        return {p.relative_to(folder): p.read_bytes() for p in files}


@settings(parent=MANY, max_examples=25)
@given(st.data())
def test_any_checkpoint_is_a_state_or_refused(data):
    name = data.draw(st.sampled_from(list(saved())))
    content = data.draw(spoiled(saved()[name] or b"0"))
    with TemporaryDirectory() as folder:
        for path, whole in saved().items():
            (Path(folder) / path).parent.mkdir(parents=True, exist_ok=True)
            (Path(folder) / path).write_bytes(content if path == name else whole)
        try:
            found = restore(Path(folder))
        except InputError as error:
            said_well(error, folder)
        else:
            assert found is None or found.variables["encoder"]["kernel"].shape == (3, 4)

"""Scripts that draw: animation, lights never seen, latent code; tiny networks."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread
from scans import write_points

from benchmarks import poisson_radii, sample_counts
from experiments import animation, environment_maps, evaluate, latent_features, shade
from ginn_jax import compare_networks, pretrained, train
from ginn_jax.dataset import count_given
from ginn_jax.errors import InputError

pytestmark = pytest.mark.usefixtures("cheap_compiling")


@cache
def untrained(effect):
    """What `load_network` gives, of the tiny network before its first step."""
    plain = replace(tiny.ONE_LEVEL, latent=4)
    lit = replace(plain, materials=1, lights=1)
    scattering = replace(lit, materials=3, asks="all", local=True)
    network = {"ao": plain, "gi": lit, "sss": scattering}[effect]
    config = replace(tiny.CONFIG, network=network)
    variables = jax.device_get(train.init_state(config).variables)
    # Values about a half: below nothing, all are shown as nothing.
    last = variables["shader"]["params"]["Dense_1"]
    last["bias"] = last["bias"] + np.float32(0.5)
    return config, tiny.ONE_LEVEL_LIMITS, variables


@pytest.fixture(autouse=True)
def tiny_networks(monkeypatch, small_programs):
    def load(effect, name):
        if name and pretrained.run_folder(name):
            return pretrained.load_network(effect, name)
        return untrained(effect)

    for module in (compare_networks, environment_maps, latent_features, shade):
        monkeypatch.setattr(module, "load_network", load)


@pytest.mark.parametrize(("effect", "disks"), [("ao", (0.75,)), ("sss", ())])
def test_animation_tells_the_flicker_of_every_method(tmp_path, effect, disks):
    options = animation.Options(
        effect,
        tmp_path,
        frames=3,
        resolution=40,
        reference=16,
        points=1200,
        draws=2,
        disks=disks,
    )
    metrics = animation.main(options)
    rows = {row["method"]: row for row in metrics["flicker"]}
    methods = {"screen space", "visibility bitmask", "ours", "2D only", "3D only"}
    methods |= {"ours, mean of 2", "ours, frame by frame"}
    own = untrained(effect)[0].network.levels[0]
    methods |= {f"ours, disk {times * own:.3g}" for times in options.disks}
    methods -= {"visibility bitmask"} if effect == "sss" else set()
    assert set(rows) == methods
    assert all(np.isfinite(row["flicker"]) for row in rows.values())
    if effect == "ao":
        assert rows["visibility bitmask"]["mse_2d"] < rows["ours"]["mse_2d"]
    assert (tmp_path / "animation.gif").stat().st_size > 1000
    assert (tmp_path / "strip.png").stat().st_size > 1000
    text = (tmp_path / "report.md").read_text()
    assert "procedural" in text
    assert all(name in text for name in methods)


SCRIPTS = animation, environment_maps, evaluate, latent_features, shade


@pytest.mark.parametrize("script", SCRIPTS)
def test_networks_of_runs_are_taken_where_they_are_named(tmp_path, script):
    options = script.Options(out=tmp_path / "out", checkpoint=str(tmp_path))
    with pytest.raises(InputError, match="no run: name the --out of one"):
        script.main(options)


def test_a_network_of_another_occlusion_radius_is_refused(tmp_path):
    options = animation.Options("ao", out=tmp_path, radius=0.2)
    with pytest.raises(InputError, match=r"learned occlusion within 0\.1, not"):
        animation.main(options)


def test_every_light_has_its_error_and_its_picture(tmp_path):
    options = environment_maps.Options(
        out=tmp_path, lights=1, point_lights=1, resolution=40, reference=8, points=1200
    )
    metrics = environment_maps.main(options)
    assert [r["light"] for r in metrics["lights"]] == ["sky 10000000", "point light 0"]
    assert all(row["relative_mse_2d"] > 0 for row in metrics["lights"])
    assert (tmp_path / "lights.png").stat().st_size > 1000
    assert "point light 0" in (tmp_path / "report.md").read_text()


def test_fewer_samples_are_given_and_others_asked(tmp_path):
    options = sample_counts.Options(
        "ao",
        out=tmp_path,
        objects=1,
        shares=(1.0, 0.5),
        points=1500,
        reference=8,
        looks=8,
    )
    whole, half = sample_counts.main(options)["rows"]
    assert (whole["samples"], half["samples"]) == (1200, 600)
    assert whole["mse_3d"] != half["mse_3d"]
    # Asked where there is no target, half of the noise would be missing.
    assert half["noise_floor_3d"] == pytest.approx(whole["noise_floor_3d"], rel=0.3)
    text = (tmp_path / "report.md").read_text()
    assert "| 1200 |" in text
    assert f"{whole['mse_3d']:.4g} | 1 |" in text


@given(count=st.integers(100, 5000), share=st.floats(0.05, 1))
def test_shares_of_a_cloud_are_of_both_its_parts(count, share):
    rows = sample_counts.rows_of(count, share)
    given_rows = rows[rows < count_given(count)]
    assert len(rows) == int(count * share)
    assert len(given_rows) == count_given(len(rows))
    assert len(set(rows)) == len(rows)
    assert rows.max() < count


def test_every_disk_radius_has_its_time_and_its_errors(tmp_path):
    options = poisson_radii.Options(
        "gi",
        out=tmp_path,
        objects=1,
        times=(1.0, 1.25),
        points=1500,
        resolution=40,
        reference=8,
        looks=8,
        rounds=2,
    )
    fine, coarse = poisson_radii.main(options)["rows"]
    assert (fine["radius"], coarse["radius"]) == (0.08, 0.1)
    assert 1200 > fine["points"] > coarse["points"] > 0
    names = ("mse_3d", "mse_2d", "relative_mse_3d", "relative_mse_2d", "seconds")
    assert all(row[name] > 0 for name in names for row in (fine, coarse))
    text = (tmp_path / "report.md").read_text()
    assert "those that come with the package" in text
    assert (tmp_path / "poisson_radii.png").stat().st_size > 1000


@pytest.mark.parametrize("effect", ["ao", "gi", "sss"])
def test_an_object_is_shaded(tmp_path, effect):
    options = shade.Options(
        effect, tmp_path, resolution=40, points=1200, looks=8, albedo=(0.9, 0.1, 0.1)
    )
    shown = imread(shade.main(options))[..., :3]
    values = np.load(tmp_path / "values.npy")
    assert values.shape == (40, 40) if effect == "ao" else (40, 40, 3)
    background, corner = (1, 1) if effect == "ao" else (0, 0)
    assert (values[0, 0] == background).all()
    assert (shown[0, 0] == corner).all()
    some = shown[values != background] if effect == "ao" else shown[values.any(-1)]
    assert 0 < len(some) < 40 * 40
    assert len(np.unique(some)) > 10
    if effect != "ao":  # of something red under light of any colour
        assert some[:, 0].mean() > 1.1 * some[:, 2].mean()


def test_the_points_of_a_scan_are_shaded(tmp_path):
    normal = np.random.default_rng(0).normal(size=(900, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    position = 7 * normal + [40, 3, -5]
    write_points(tmp_path / "scan.ply", np.concatenate([position, normal], axis=1))
    options = shade.Options(out=tmp_path, scan=tmp_path / "scan.ply")
    found = trimesh.load(shade.main(options))
    values = np.load(tmp_path / "values.npy")
    np.testing.assert_allclose(found.vertices, position, rtol=1e-6)
    np.testing.assert_array_equal(found.colors[:, 1], np.round(255 * values))
    assert values.min() >= 0
    assert np.ptp(values) > 0.01


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scan": Path("a.ply"), "effect": "gi"}, "--scan is for occlusion"),
        ({"scan": Path("a.ply"), "azimuth": 3.0}, "--azimuth is of images"),
        (
            {"scan": Path("a.ply"), "resolution_scale": 0.5},
            "--resolution-scale is of images",
        ),
        ({"scan": Path("a.ply"), "mesh": Path("a.obj")}, "--scan is for occlusion"),
        ({"scan": Path("no.ply")}, "no.ply: no such file"),
        ({"envmap": Path("sky.hdr")}, "--envmap is light, occlusion has none"),
        ({"effect": "sss", "ior": 2.0}, "--ior 2.0 must be"),
        ({"effect": "sss", "extinction": 0.0}, "--extinction 0.0 must be"),
        ({"effect": "gi", "albedo": (2.0, 0.0, 0.0)}, "an albedo above 1"),
        ({"resolution_scale": 0.4}, "0.4"),
    ],
)
def test_what_cannot_be_shaded_is_named(tmp_path, wrong, message):
    usual = {"effect": "ao", "resolution": 32, "points": 1000, "looks": 1}
    if "scan" in wrong:  # of which no image is made
        usual = {}
    with pytest.raises(InputError, match=message):
        shade.main(shade.Options(out=tmp_path / "out", **usual | wrong))


@pytest.mark.parametrize("effect", ["ao", "gi"])
def test_latent_features_are_drawn(tmp_path, effect):
    options = latent_features.Options(
        effect, out=tmp_path, channels=2, resolution=40, points=1200
    )
    assert latent_features.main(options).stat().st_size > 1000


def test_ranks_tell_every_value_from_the_others():
    columns = np.random.default_rng(0).normal(size=(50, 3))
    ranks = latent_features.ranked(columns)
    assert (ranks.min(), ranks.max()) == (0, 1)
    for column, rank in zip(columns.T, ranks.T, strict=True):
        np.testing.assert_array_equal(column.argsort(), rank.argsort())


def test_principal_components_find_the_plane_of_a_flat_code():
    rng = np.random.default_rng(1)
    flat = rng.normal(size=(80, 2)) * [5.0, 1.0] @ rng.normal(size=(2, 8))
    ranks = latent_features.principal(flat)
    assert ranks.shape == (80, 3)
    _, axes = np.linalg.eigh(np.cov(flat.T))
    order = (flat @ axes[:, -1]).argsort()
    assert (np.diff(ranks[order, 0]) > 0).all() or (np.diff(ranks[order, 0]) < 0).all()


def test_no_light_at_all_is_refused(tmp_path):
    options = environment_maps.Options(out=tmp_path, lights=0, point_lights=0)
    with pytest.raises(InputError, match="both 0"):
        environment_maps.main(options)


@pytest.mark.parametrize("name", ["frames", "resolution", "reference", "points"])
def test_options_that_cannot_be_meant_are_refused(tmp_path, name):
    with pytest.raises(InputError, match=f"--{name}"):
        animation.main(replace(animation.Options(out=tmp_path), **{name: 1}))

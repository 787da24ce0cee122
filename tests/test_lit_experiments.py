"""The experiments and benchmarks of light, small, from nothing to their reports."""

import json
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny

from benchmarks import frame, generation
from benchmarks import relight as relight_benchmark
from experiments import gi_train, sss_train
from ginn_jax import blocks, evaluate, evaluate_light, lit_views, presets, train
from ginn_jax.errors import InputError
from ginn_jax.lit_clouds import LitCloud
from ginn_jax.lit_options import LitOptions, choose_sources

SMALL = {
    "shapes": 2,
    "test_shapes": 2,
    "paths": 4,
    "points": 1000,
    "steps": 2,
    "resolution": 32,
    "resolution_scale": 1.0,
    "quick": True,
}
EFFECTS = {
    "gi": (gi_train, presets.ILLUMINATION, {"materials": 1}),
    "sss": (sss_train, presets.SCATTERING, {"materials": 3, "asks": "all"}),
}


@pytest.mark.usefixtures("small_programs")
@pytest.mark.parametrize("effect", EFFECTS)
def test_a_small_run_leaves_all_that_is_promised(effect, tmp_path, monkeypatch):
    script, table, more = EFFECTS[effect]
    network = replace(tiny.ONE_LEVEL, lights=1, **more)
    monkeypatch.setitem(table, "homogeneous", network)
    # That they are measured is tested where occlusion is.
    room = tiny.ample_room(network)
    monkeypatch.setattr("ginn_jax.fit.training_room", lambda *_: room)
    options = script.Options(out=tmp_path, **SMALL)
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        script.main(options)
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert metrics["steps"] == 2
    assert metrics["unseen shapes"]["clouds"] == 2
    assert metrics["unseen point lights"]["clouds"] == 2
    for key in ("relative_mse_3d", "equal_rays", "relative_mse_2d", "dssim_2d"):
        assert np.isfinite(metrics[key])
    paths = [r["mse_2d"] for r in metrics["error_against_time"] if "paths" in r]
    assert paths[0] > paths[-1]
    for name in ("learning_curve", "views", "error_against_time"):
        assert (tmp_path / f"{name}.png").stat().st_size > 1000
    text = (tmp_path / "report.md").read_text()
    assert "unseen point lights" in text
    assert "rays of equal MSE" in text
    assert ("denser half of the media" in text) == (effect == "sss")
    if effect == "gi":
        return
    rows = [
        row for name in ("shapes", "point lights") for row in media_of(metrics, name)
    ]
    clear = metrics["unseen, clearer half of the media"]
    two = sorted(rows)[:2]
    assert clear["mse_3d"] == pytest.approx(np.mean([error for _, error in two]))
    with pytest.raises(InputError, match="--size"):
        script.main(replace(options, size=0.0))


def media_of(metrics, name):
    """Extinction and error of every scene of a set."""
    rows = metrics[f"unseen {name}, each"]
    return [(row["extinction"], row["mse_3d"]) for row in rows]


def test_seen_and_unseen_share_no_object_and_no_light(tmp_path):
    maps = tmp_path / "maps"
    maps.mkdir()
    (maps / "a.hdr").write_bytes(b"seen")
    options = LitOptions(shapes=40, envmaps=maps, lights=2)
    seen, unseen = choose_sources(options)
    assert len(seen) == 80
    assert len({s.name for s in seen}) == 80
    tests = [s for sources in unseen.values() for s in sources]
    for part in ("seed", "name"):
        lights = [{getattr(s.light, part) for s in side} for side in (seen, tests)]
        assert not lights[0] & lights[1]
    objects = [{s.name.split("__")[0] for s in side} for side in (seen, tests)]
    assert not objects[0] & objects[1]
    assert any(s.light.path for s in seen)


@pytest.mark.parametrize("each", [1, 3])
def test_every_map_lights_something(tmp_path, each):
    maps = tmp_path / "maps"
    maps.mkdir()
    for i in range(20):
        (maps / f"map_{i}.hdr").write_bytes(b"seen")
    options = LitOptions(shapes=40, envmaps=maps, lights=each)
    seen, _ = choose_sources(options)
    used = [s.light.path for s in seen]
    assert len({path for path in used if path}) == 20
    assert None in used
    again, _ = choose_sources(options)
    other, _ = choose_sources(replace(options, seed=1))
    assert [s.light.path for s in again] == used
    assert [s.light.path for s in other] != used


def test_unseen_maps_are_spread_over_the_folder(tmp_path):
    """Few shapes see the last maps as well as the first; shapes in turns see all."""
    for i in range(9):
        (tmp_path / f"map_{i}.hdr").write_bytes(b"unseen")
    for count, wanted in ((3, "036"), (9, "012345678"), (11, "01234567801")):
        options = LitOptions(shapes=40, test_envmaps=tmp_path, test_shapes=count)
        _, unseen = choose_sources(options)
        used = [Path(s.light.path).stem for s in unseen["shapes"]]
        assert used == [f"map_{digit}" for digit in wanted]


def test_without_maps_shapes_keep_their_skies():
    """What was made of them before is found again."""
    seen, _ = choose_sources(LitOptions(shapes=40))
    assert [s.name for s in seen] == [f"shape_{i}__sky_{i}" for i in range(40)]


def test_the_papers_split_says_what_it_lacks():
    options = LitOptions(shapes=40, split="paper")
    with pytest.raises(InputError, match="1700"):
        choose_sources(options)
    seen, unseen = choose_sources(replace(options, shapes=1700))
    assert len(seen) == 1000 * 20
    assert {name: len(s) for name, s in unseen.items()} == {
        "test": 500 * 5,
        "validation": 200 * 5,
    }
    lights = [{s.light.name for s in part} for part in (seen, *unseen.values())]
    assert not lights[0] & (lights[1] | lights[2])
    assert not lights[1] & lights[2]


def test_the_papers_split_is_of_the_maps_that_are_given(tmp_path):
    for i in range(30):
        (tmp_path / f"map_{i}.hdr").write_bytes(b"one")
    options = LitOptions(shapes=1700, split="paper", envmaps=tmp_path)
    seen, unseen = choose_sources(options)
    assert all(s.light.path for part in (seen, *unseen.values()) for s in part)
    with pytest.raises(InputError, match=r"^--split paper tests on parts"):
        choose_sources(replace(options, test_envmaps=tmp_path))


def test_what_is_tested_on_is_not_trained_on(tmp_path):
    """Known by its contents, whatever it is called."""
    for folder, name, content in (
        ("seen", "a.hdr", b"one"),
        ("seen", "b.hdr", b"two"),
        ("unseen", "c.hdr", b"three"),
        ("again", "d.hdr", b"three"),
        ("again", "e.hdr", b"two"),
    ):
        (tmp_path / folder).mkdir(exist_ok=True)
        (tmp_path / folder / name).write_bytes(content)
    options = LitOptions(shapes=20, test_shapes=2, envmaps=tmp_path / "seen")
    choose_sources(replace(options, test_envmaps=tmp_path / "unseen"))
    with pytest.raises(InputError, match=r"again/e\.hdr is to be trained on as well"):
        choose_sources(replace(options, test_envmaps=tmp_path / "again"))


def cloud_of(light, seed=0):
    """Random points whose target is noise about half of their light."""
    rng = np.random.default_rng(seed)
    count = len(light)
    noise = 0.1 * light.mean(axis=0) * rng.normal(size=light.shape)
    columns = (
        rng.normal(size=(count, 3)),
        rng.normal(size=(count, 3)),
        np.zeros(count),
        light,
        0.5 * light + noise,
        np.broadcast_to((0.1 * light.mean(axis=0)) ** 2, light.shape),
    )
    kinds = ("f4", "f4", "i4", "f4", "f4", "f4")
    arrays = (np.asarray(c, k) for c, k in zip(columns, kinds, strict=True))
    return LitCloud(*arrays, np.ones((1, 3), np.float32), np.zeros(0))


def test_errors_are_in_units_of_light_and_free_of_noise():
    light = np.random.default_rng(1).gamma(1.0, size=(20000, 3)).astype(np.float32)
    units, cloud = light.mean(axis=0), cloud_of(light)
    exact = evaluate_light.unit_errors(units, cloud, 0.5 * light)
    assert abs(exact["mse_3d"]) < 1e-3
    assert exact["noise_floor_3d"] == pytest.approx(0.01, rel=0.01)
    wrong = evaluate_light.unit_errors(units, cloud, 0.5 * light + 0.2 * units)
    assert wrong["mse_3d"] == pytest.approx(0.04, rel=0.05)
    assert wrong["relative_mse_3d"] == pytest.approx(0.04 / 0.25, rel=0.06)
    bright = cloud_of(1e4 * light)
    again = evaluate_light.unit_errors(1e4 * units, bright, 5e3 * light)
    assert again["mse_3d"] == pytest.approx(exact["mse_3d"], abs=1e-5)


def test_clouds_without_light_are_left_out_and_counted():
    row = {"mse_3d": 0.5, "noise_floor_3d": 0.1, "variance_3d": 2.0}
    row |= {"ray_variance": 8.0, "relative_mse_3d": 0.25}
    dark = dict.fromkeys(row, float("nan"))
    pooled = evaluate.pool_rows([row, dark, row])
    assert (pooled["clouds"], pooled["dark_clouds"]) == (2, 1)
    assert (pooled["relative_mse_3d"], pooled["equal_rays"]) == (0.25, 16.0)
    with pytest.raises(InputError, match=r"^no light reaches any of the clouds"):
        evaluate.pool_rows([dark])


def test_unlit_channels_have_no_say():
    light = np.random.default_rng(1).gamma(1.0, size=(2000, 3)).astype(np.float32)
    light[:, 2] = 0
    units = light.mean(axis=0)
    found = evaluate_light.unit_errors(units, cloud_of(light), 0.5 * light)
    assert np.isfinite(list(found.values())).all()
    squared, scale = np.array([4.0, 9.0, 0.0]), np.array([2.0, 3.0, 0.0])
    assert evaluate_light.in_units(squared, scale) == 1.0
    assert evaluate_light.in_units(np.array([4.0, 8.0, 0.0]), np.array([2.0])) == 1.0
    assert np.isnan(evaluate_light.in_units(squared, np.zeros(3)))


def test_grey_light_on_grey_things_is_one_channel():
    numbers = np.random.default_rng(0).uniform(size=(1, 5, 1)).repeat(3, axis=0)
    assert lit_views.distinct_channels(numbers, numbers)[0].shape[0] == 1
    coloured = numbers * np.array([1, 1, 2])[:, None, None]
    assert lit_views.distinct_channels(numbers, coloured)[1].shape[0] == 3


@pytest.mark.usefixtures("small_programs")
def test_relight_and_frame_benchmarks(tmp_path, monkeypatch):
    options = relight_benchmark.Options(
        out=tmp_path, resolution=24, points=1000, repeats=1, networks=("ao",)
    )
    with pytest.raises(InputError, match="ao takes no light"):
        relight_benchmark.main(options)
    with pytest.raises(InputError, match="no trained network 'none'"):
        relight_benchmark.main(replace(options, networks=("none",)))
    network = replace(tiny.ONE_LEVEL, lights=1, materials=1)
    config = replace(tiny.CONFIG, network=network)
    with tiny.cheap_compiling():
        weights = jax.device_get(train.init_state(config).variables)
        trained = config, tiny.ONE_LEVEL_LIMITS, weights
        monkeypatch.setattr(relight_benchmark, "load_any", lambda name: trained)
        metrics = relight_benchmark.main(options)
        [row] = metrics["rows"]
        assert row["largest_difference"] < 1e-3
        monkeypatch.setattr(frame, "load_any", lambda name: trained)
        more = frame.Options(tmp_path, ("gi",), resolution=24, points=1000, repeats=1)
        [case] = frame.main(more)["cases"]
        made = frame.make_frame(more, network, "gi")
        calls = frame.calls_of(network, trained[1], weights, made)
        values, _ = calls["f_2D in blocks, programs"]()
        seen = calls["f_2D"]()[made.gbuffer.mask]
    assert case["pixels"] == len(seen)
    # The same pixels in an order of their own; what is below zero shows as black.
    alone = np.maximum(blocks.in_rows(values)[: len(seen)], 0.0)
    np.testing.assert_allclose(np.sort(alone, 0), np.sort(seen, 0), atol=1e-5)


def test_generation_benchmark(tmp_path):
    options = generation.Options(
        out=tmp_path, scenes=1, points=2000, paths=16, repeats=1
    )
    [row] = generation.main(options)["rows"]
    assert row["mean_difference"] < 0.1

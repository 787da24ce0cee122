"""Errors, times and tables of evaluations, worked out by hand."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
import tiny
from shots import gray_shot, lit_shot

from ginn_jax import (
    compare,
    compare_pictures,
    compare_tracing,
    evaluate,
    evaluate_light,
    lit_views,
    metrics,
)
from ginn_jax.compare import Picture
from ginn_jax.compare_networks import OURS
from ginn_jax.compare_report import summary
from ginn_jax.compare_screen import screen_methods
from ginn_jax.dataset import ShadedPoints
from ginn_jax.evaluate import Model
from ginn_jax.lit_scenes import Illumination, Scattering
from ginn_jax.receptive_field import Oriented
from ginn_jax.reference import Estimate
from ginn_jax.scenes import Occlusion
from ginn_jax.shading import Encoded

MEDIUM = (8.0, 1.3)


def test_errors_of_occlusion_in_an_image():
    shot = gray_shot()
    mask, right = shot.gbuffer.mask, shot.reference
    noise = float(shot.variance.mean())
    off = np.where(mask, right + np.float32(0.1), np.float32(0))
    row = evaluate.image_errors(shot, off)
    assert row["mse_2d"] == pytest.approx(0.01 - noise, abs=1e-5)
    # The background, which is 1 in the reference, does not count.
    same = evaluate.image_errors(shot, np.where(mask, right, np.float32(0)))
    assert same["dssim_2d"] == pytest.approx(0, abs=1e-9)
    assert evaluate.image_errors(shot, 2 * right)["dssim_2d"] > 0.01
    row = compare.errors(shot, right[mask], None)
    assert row["variance_2d"] == pytest.approx(right[mask].var() - noise, abs=1e-5)


def test_errors_of_light_in_an_image():
    """In units of each channel's light, less the noise of each."""
    shot, scale = lit_shot(), np.float32([2, 1, 0.5])
    target = shot.pixels.target
    off = target + np.float32([0.2, 0.1, 0.3])
    row = evaluate_light.lit_image_errors(shot, off, scale)
    by_channel = (0.04 - 0.01) / 4, (0.01 - 0.04) / 1, (0.09 - 0.09) / 0.25
    assert row["mse_2d"] == pytest.approx(np.mean(by_channel), abs=1e-5)
    spread = target.astype(float).var(0) - [0.01, 0.04, 0.09]
    spread = (spread / scale.astype(float) ** 2).mean()
    assert row["variance_2d"] == pytest.approx(spread, rel=1e-4)


@pytest.mark.parametrize("medium", [(), MEDIUM])
def test_what_is_displayed(medium):
    shot = lit_shot(medium)
    pixels, mask = shot.pixels, shot.gbuffer.mask
    own = pixels.albedo[pixels.material]
    radiant = pixels.target if medium else (pixels.irradiance + pixels.target) * own
    found = lit_views.displayed(shot, pixels.target)
    np.testing.assert_allclose(found[mask], radiant / np.pi, rtol=1e-5)
    assert not found[~mask].any()
    factor = np.ones_like(own) if medium else own
    np.testing.assert_allclose(compare.albedo_of(shot)[mask], factor)


def test_one_channel_only_where_light_and_things_are_grey():
    grey = np.ones((3, 5, 1), np.float32)
    red = grey * np.float32([1, 2, 3])[:, None, None]
    count = {
        (name, other): len(lit_views.distinct_channels(a, b)[0])
        for name, a in (("grey", grey), ("red", red))
        for other, b in (("grey", grey), ("red", red))
    }
    assert count.pop(("grey", "grey")) == 1
    assert set(count.values()) == {3}


def test_codes_of_grey_things_have_three_channels_unless_merged(monkeypatch):
    """So that what is asked of them is an image in colour, whatever the light."""
    pixels, model = lit_shot().pixels, Model({}, jax.random.key(0))
    grey = {n: np.ones_like(getattr(pixels, n)) for n in ("irradiance", "albedo")}

    blank, channels = Encoded(None, None, None, None, None), []  # type: ignore

    def encoded(*given, **_):
        channels.append([len(numbers) for numbers in given[5:7]])
        return blank, tiny.LIMITS

    monkeypatch.setattr(lit_views, "encode_cloud", encoded)
    given = tiny.NETWORK, tiny.LIMITS, model, pixels._replace(**grey)
    lit_views.encode_lit(*given)
    lit_views.encode_lit(*given, merge_grey=True)
    assert channels == [[3, 3], [1, 1]]


def test_screen_space_is_given_what_surfaces_send_out():
    shot = lit_shot()
    pixels, mask = shot.pixels, shot.gbuffer.mask
    pairs = zip(pixels.material, pixels.irradiance, strict=True)
    sent = np.array([pixels.albedo[m] * light for m, light in pairs])
    methods = screen_methods(shot, Illumination())
    assert len(methods) == 2
    for _, images, static in methods.values():
        np.testing.assert_allclose(images[3][mask], sent, rtol=1e-6)
        assert not images[3][~mask].any()
        assert static == {}
    [(_, images, static)] = screen_methods(lit_shot(MEDIUM), Scattering()).values()
    np.testing.assert_array_equal(images[3][mask], pixels.irradiance)
    assert (static["extinction"], static["ior"]) == MEDIUM


def test_a_reference_of_other_settings_is_traced_again(tmp_path, monkeypatch):
    shot, counts = gray_shot(), []
    count = int(shot.gbuffer.mask.sum())

    def trace(shot, settings, rays, *, seed):
        counts.append(rays)
        mean = np.full(count, 1 / rays, np.float32)
        return Estimate(mean, np.zeros(count, np.float32))

    monkeypatch.setattr(compare_tracing, "trace", trace)
    path = tmp_path / "a.npz"
    for rays in (4, 4, 16):
        given = shot, Occlusion(), rays, path, {"reference": rays}
        found = compare_tracing.with_reference(*given, seed=0)
        assert (found.reference[shot.gbuffer.mask] == np.float32(1 / rays)).all()
    assert counts == [4, 16]


def test_a_mean_of_draws_costs_the_time_of_all(monkeypatch):
    shot = gray_shot()
    count = int(shot.gbuffer.mask.sum())
    names = "seconds_3d", "seconds_2d", "seconds"

    def picture(n):
        row = {"method": OURS} | dict.fromkeys(names, float(n))
        return Picture(row, np.full(count, n / 4, np.float32))

    others = map(picture, (2, 3))
    monkeypatch.setattr(
        compare_pictures, "network_picture", lambda *_: (next(others), None)
    )
    own = tiny.ONE_LEVEL, tiny.ONE_LEVEL_LIMITS, Model({}, jax.random.key(0))
    cloud = tiny.sphere_on_plane(10, 0)
    found = compare_pictures.mean_picture(picture(1), own, cloud, shot, 3, None)
    assert (found.values == 0.5).all()
    assert [found.row[name] for name in names] == [6, 6, 6]


def test_a_guess_by_twenty_rays_is_worth_twenty(monkeypatch):
    rng, rays, count = np.random.default_rng(0), 64, 200_000
    chance = rng.uniform(size=count)
    mean = rng.binomial(rays, chance) / rays
    variance = mean * (1 - mean) / (rays - 1)
    place = np.zeros((count, 3), np.float32)
    truth = (a.astype(np.float32) for a in (mean, variance))
    cloud = ShadedPoints(place, place, *truth)
    asked = chance[count * 4 // 5 :]
    guess = (rng.binomial(20, asked) / 20).astype(np.float32)
    codes = Encoded(
        Oriented(place, place, np.ones(count, bool)), None, None, None, None
    )
    monkeypatch.setattr(
        evaluate, "encode_cloud", lambda _, limits, *__, key: (codes, limits)
    )
    monkeypatch.setattr(
        evaluate, "shade_points", lambda _, limits, *__: (guess, limits)
    )
    model = Model({}, jax.random.key(0))
    given = tiny.NETWORK, tiny.LIMITS, model, [cloud], ["a"], rays
    pooled = evaluate.pool_rows(evaluate.evaluate_clouds(*given)[0])
    assert pooled["equal_rays"] == pytest.approx(20, rel=0.05)
    assert pooled["relative_mse_3d"] == pytest.approx(0.1, rel=0.05)


def test_rows_that_differ_are_pooled_by_their_means():
    rows = [
        {"mse_3d": m, "variance_3d": v, "noise_floor_3d": 0.1, "ray_variance": r}
        | {"relative_mse_3d": m / v}
        for m, v, r in ((1.0, 2.0, 3.0), (2.0, 4.0, 3.0), (6.0, 4.0, 6.0))
    ]
    pooled = evaluate.pool_rows(rows)
    relative = pooled["relative_mse_3d"], pooled["median_relative_mse_3d"]
    assert relative == pytest.approx((0.9, 0.5))
    assert pooled["equal_rays"] == pytest.approx(4 / 3)
    shots = [{"method": "a", "mse_2d": m, "variance_2d": 4.0} for m in (1.0, 3.0)]
    assert evaluate.mean_rows(shots)[0]["mse_2d"] == 2
    means = evaluate.mean_rows([shots[0], shots[1] | {"method": "b"}, shots[1]])
    assert [row["mse_2d"] for row in means] == [2, 3]


def test_one_shot_in_which_the_machine_had_other_work_makes_no_time():
    shots = [{"method": "a", "mse_2d": m, "seconds": s} for m, s in ((1, 2), (3, 99))]
    [pooled] = evaluate.mean_rows([*shots, {"method": "a", "mse_2d": 5, "seconds": 3}])
    assert (pooled["mse_2d"], pooled["seconds"]) == (3, 3)


def test_fronts_are_told_apart():
    """Kept codes and light that is counted have fronts of their own."""
    base = {"name": "cow", "variance_2d": 1.0, "dssim_2d": 0.1, "seconds_2d": 0.5}
    ours = base | {"method": OURS, "mse_2d": 0.1, "seconds": 2.0}
    kept = ours | {"method": "kept one", "seconds": 0.5, "kept": 1}
    rays = {"method": "1 rays", "mse_2d": 0.5, "seconds": 1.0, "traced": 1}
    found = summary("ao", {}, [ours], [ours, kept, base | rays], [])
    assert found["front_mse"] == ["1 rays", OURS]
    assert found["front_counted"] == ["1 rays"]
    assert found["front_kept"] == ["kept one"]
    assert found["share_2d"] == 0.25


def test_relative_errors_have_an_interval_over_scenes_not_views():
    shots = [
        {"method": OURS, "name": name, "mse_2d": error, "variance_2d": 1.0}
        | {"seconds_2d": 1.0, "seconds": 1.0, "dssim_2d": 0.1}
        for name, errors in {"cow": (0.0, 0.2), "well": (0.3, 0.5)}.items()
        for error in errors
    ]
    [row] = summary("ao", {}, shots, shots, [])["results"]
    # Of two scenes one is drawn twice every other time.
    assert (row["low_2d"], row["high_2d"]) == pytest.approx((0.1, 0.4))


def test_a_time_is_the_median_of_three_calls_after_a_first(monkeypatch):
    ticks, calls = iter([0.0, 5.0, 10.0, 11.0, 20.0, 22.0]), []
    clock = SimpleNamespace(perf_counter=lambda: next(ticks))
    monkeypatch.setattr(evaluate, "time", clock)
    result, seconds = evaluate.timed(lambda: calls.append(0) or len(calls))
    assert (result, len(calls), seconds) == (4, 4, 2.0)


@pytest.mark.parametrize(("channel", "share"), [*enumerate((0.2126, 0.7152, 0.0722))])
def test_every_primary_has_its_share_of_luminance(channel, share):
    colour = np.zeros((1, 11, 3))
    colour[..., channel] = np.arange(11.0)
    shown = metrics.tone_map(np.full((1, 1, 3), 0.1), colour)
    np.testing.assert_allclose(shown, (0.1 / (9 * share)) ** (1 / 1.6))


def test_tracing_is_extrapolated_from_the_largest_count():
    """As 1 / count, though it fell less than that between the two."""
    found = metrics.equal_tracing(0.1, 1.0, [(4, 0.3, 4.0), (1, 1.0, 1.0)])
    assert found[0] == pytest.approx(12)

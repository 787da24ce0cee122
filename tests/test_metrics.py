"""Metrics against hand-written loops and hand-computed numbers."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from ginn_jax import metrics
from ginn_jax.errors import InputError

unit = st.floats(0, 1, width=32, allow_subnormal=False)
images = arrays(np.float32, (12, 13), elements=unit)


def ssim_loop(a, b, row, column):
    """SSIM at one pixel, written from the definition (Wang et al. 2004)."""
    total = weight_sum = ma = mb = 0.0
    window = []
    for dy in range(-5, 6):
        for dx in range(-5, 6):
            w = math.exp(-(dx * dx + dy * dy) / (2 * 1.5**2))
            window.append(
                (w, float(a[row + dy, column + dx]), float(b[row + dy, column + dx]))
            )
            weight_sum += w
    window = [(w / weight_sum, x, y) for w, x, y in window]
    for w, x, y in window:
        ma += w * x
        mb += w * y
    va = sum(w * (x - ma) ** 2 for w, x, _ in window)
    vb = sum(w * (y - mb) ** 2 for w, _, y in window)
    total = sum(w * (x - ma) * (y - mb) for w, x, y in window)
    c1, c2 = 0.01**2, 0.03**2
    luminance = (2 * ma * mb + c1) / (ma**2 + mb**2 + c1)
    return luminance * (2 * total + c2) / (va + vb + c2)


def noisy_pair(shape, seed=0):
    rng = np.random.default_rng(seed)
    a = rng.uniform(0, 1, shape)
    return a, np.clip(a + rng.normal(0, 0.2, shape), 0, 1)


def test_dssim_equals_the_definition():
    a, b = noisy_pair((17, 15))
    inner = [ssim_loop(a, b, i, j) for i in range(5, 12) for j in range(5, 10)]
    assert metrics.dssim(a, b) == pytest.approx((1 - np.mean(inner)) / 2, abs=1e-9)


def test_masked_dssim_equals_the_definition_on_black_background():
    a, b = noisy_pair((17, 15))
    mask = np.zeros((17, 15), bool)
    mask[6:10, 5:9] = True
    black = [np.where(mask, image, 0) for image in (a, b)]
    inner = [ssim_loop(*black, i, j) for i, j in np.argwhere(mask)]
    expected = (1 - np.mean(inner)) / 2
    assert metrics.dssim(a, b, mask) == pytest.approx(expected, abs=1e-9)


def test_a_mask_may_be_a_list(unchecked):
    a, b = np.random.default_rng(3).uniform(size=(2, 12, 13))
    mask = a > 0.3
    for metric in (metrics.mse, metrics.dssim):
        assert metric(a, b, mask.tolist()) == metric(a, b, mask)


def test_dssim_averages_channels():
    a, b = noisy_pair((14, 16, 3))
    each = [metrics.dssim(a[..., c], b[..., c]) for c in range(3)]
    assert metrics.dssim(a, b) == pytest.approx(np.mean(each), abs=1e-12)
    mask = a[..., 0] > 0.4
    each = [metrics.dssim(a[..., c], b[..., c], mask) for c in range(3)]
    assert metrics.dssim(a, b, mask) == pytest.approx(np.mean(each), abs=1e-12)


@settings(deadline=None)
@given(images, images)
def test_dssim_is_symmetric_bounded_and_zero_only_for_equal(a, b):
    assert metrics.dssim(a, a) == pytest.approx(0, abs=1e-12)
    assert metrics.dssim(a, b) == pytest.approx(metrics.dssim(b, a), abs=1e-12)
    assert -1e-12 <= metrics.dssim(a, b) <= 1


@settings(deadline=None)
@given(images, images, arrays(bool, (12, 13)))
def test_mse_is_a_loop_over_the_mask(a, b, mask):
    kept = [(float(a[i]) - float(b[i])) ** 2 for i in np.ndindex(12, 13) if mask[i]]
    if kept:
        expected = math.fsum(kept) / len(kept)
        assert metrics.mse(a, b, mask) == pytest.approx(expected, rel=1e-9)
        assert metrics.mse(a, b, mask) == metrics.mse(b, a, mask)
    else:
        with pytest.raises(InputError, match="nothing to average"):
            metrics.mse(a, b, mask)


def test_mse_counts_channels_alike_and_ignores_what_the_mask_hides():
    a, b = np.zeros((2, 2, 3)), np.zeros((2, 2, 3))
    b[0, 0], b[1, 1] = (3, 0, 0), np.nan
    mask = np.array([[True, True], [True, False]])
    assert metrics.mse(a, b, mask) == 1
    with pytest.raises(InputError, match="finite"):
        metrics.mse(a, b)


def test_noise_floor_is_subtracted():
    """A prediction wrong by .1 everywhere, against a target with known noise."""
    rng = np.random.default_rng(1)
    truth = rng.uniform(0, 1, 200_000)
    target, noise = truth + rng.normal(0, 0.3, truth.shape), np.full(truth.shape, 0.09)
    assert metrics.mse(truth + 0.1, target) == pytest.approx(0.1, rel=0.02)
    assert metrics.true_mse(truth + 0.1, target, noise) == pytest.approx(0.01, abs=2e-3)
    error = metrics.true_mse(np.full(truth.shape, 0.5), target, noise)
    spread = float(target.var() - noise.mean())
    assert metrics.relative_error(error, spread) == pytest.approx(1, rel=0.05)


def test_a_constant_target_gives_an_error_no_scale():
    for variance in (0.0, -1e-9):
        assert np.isnan(metrics.relative_error(0.0, variance))
    assert metrics.median_known([np.nan, 3.0, 1.0, np.nan, 2.0]) == 2.0
    assert np.isnan(metrics.median_known([np.nan]))


def test_equal_rays_inverts_the_error_of_ray_tracing():
    rng = np.random.default_rng(2)
    p = rng.uniform(0, 1, 100_000)
    error = metrics.mse(rng.binomial(20, p) / 20, p)
    rays = metrics.equal_rays(error, float((p * (1 - p)).mean()))
    assert rays == pytest.approx(20, rel=0.03)
    assert metrics.equal_rays(0.0, 0.1) == math.inf
    with pytest.raises(InputError):
        metrics.equal_rays(math.nan, 0.1)


def test_tone_map_by_hand():
    reference = np.arange(11.0).reshape(1, 11)  # .9 percentile: 9
    shown = metrics.tone_map(np.array([[0, 4.5, 9, 20]]), reference)
    np.testing.assert_allclose(shown, [[0, 0.5 ** (1 / 1.6), 1, 1]])
    mask = reference < 6  # .9 percentile of 0..5: 4.5
    np.testing.assert_allclose(metrics.tone_map(reference, reference, mask)[0, 5], 1)
    colour = np.zeros((1, 11, 3))
    colour[..., 1] = reference  # luminance .7152 of green
    green = metrics.tone_map(colour, colour)[0, 3, 1]
    assert green == pytest.approx((3 / (9 * 0.7152)) ** (1 / 1.6))
    np.testing.assert_array_equal(metrics.tone_map(reference * 0, reference * 0), 0)


@settings(deadline=None)
@given(images, st.floats(0.01, 100))
def test_tone_map_ignores_exposure_and_stays_in_range(image, exposure):
    bright = image.astype(np.float64) * exposure
    shown = metrics.tone_map(bright, bright)
    assert shown.min() >= 0
    assert shown.max() <= 1
    if np.percentile(image, 90) > 0:
        np.testing.assert_allclose(shown, metrics.tone_map(image, image), atol=1e-6)


@pytest.mark.parametrize(
    ("b", "mask", "message"),
    [
        (np.zeros((12, 13)), None, r"shapes \(12, 12\) and \(12, 13\) differ"),
        (np.zeros((12, 12)), np.ones((12, 11), bool), r"mask bool\(12, 11\) does not"),
        (np.zeros((12, 12)), np.ones((12, 12)), r"mask float64\(12, 12\) does not fit"),
        (np.full((12, 12), np.nan), None, "values to compare are not finite"),
    ],
)
def test_what_does_not_fit_is_refused(b, mask, message, unchecked):
    for metric in (metrics.mse, metrics.dssim):
        with pytest.raises(InputError, match=message):
            metric(np.zeros((12, 12)), b, mask)


@pytest.mark.parametrize("shape", [(5, 4), (5, 4, 3)])
def test_all_of_a_black_reference_counts(shape):
    picture = np.zeros(shape)
    assert metrics.foreground(picture).all()
    picture[2, 1] = 1
    assert np.argwhere(metrics.foreground(picture)).tolist() == [[2, 1]]


def test_dssim_refuses_small_images():
    with pytest.raises(InputError, match="11 pixels"):
        metrics.dssim(np.zeros((10, 20)), np.zeros((10, 20)))


@given(st.floats(1e-3, 1e3), st.floats(0, 1), st.floats(1e-3, 1), st.floats(1e-6, 1e3))
def test_tracing_at_equal_error_and_at_equal_time(single, start, slope, error):
    """Where MSE is single / count and time start + slope count, by hand."""
    traced = [(n, single / n, start + slope * n) for n in (16, 1, 4)]
    equal, seconds, ratio = metrics.equal_tracing(error, start + 8 * slope, traced)
    assert equal == pytest.approx(single / error)
    assert seconds == pytest.approx(start + slope * single / error, rel=1e-6)
    assert ratio == pytest.approx(single / 8 / error, rel=1e-6)
    shrinking = [(n, e, 9.0 - n / 4) for n, e, _ in traced]
    mean = 9.0 - (16 + 1 + 4) / 4 / 3
    _, flat, ratio = metrics.equal_tracing(error, mean - 0.1, shrinking)
    assert flat == pytest.approx(mean)
    assert ratio == pytest.approx(single / error)
    # Where there is time for any of them there is time for the most.
    ratio = metrics.equal_tracing(error, mean + 0.1, shrinking)[2]
    assert ratio == pytest.approx(single / 16 / error)
    at_once = metrics.equal_tracing(error, 0.0, traced)
    assert at_once[2] == pytest.approx(single / error)


def test_interval_of_a_pooled_error_is_that_of_a_ratio_of_means():
    """Against the linearised spread of the ratio, of clouds that are alike."""
    rng = np.random.default_rng(1)
    variance = rng.uniform(0.5, 1.5, 400)
    error = variance * rng.exponential(0.1, 400)
    ratio = error.sum() / variance.sum()
    off = (error - ratio * variance) / variance.mean()
    sigma = off.std(ddof=1) / np.sqrt(400)
    found = metrics.pooled_interval(list(error), list(variance))
    expected = ratio - 1.96 * sigma, ratio + 1.96 * sigma
    assert found == pytest.approx(expected, abs=0.2 * sigma)
    assert found == metrics.pooled_interval(list(error), list(variance))
    same = metrics.pooled_interval(list(0.3 * variance), list(variance))
    assert same == pytest.approx((0.3, 0.3))
    for few in ([], [0.1]):
        assert np.isnan(metrics.pooled_interval(few, few)).all()


def test_tracing_that_falls_faster_than_independent_rays():
    """As count^-2 to 4 rays, count^-1 to 16; then a measurement that noise sank."""
    traced = [(1, 1.0, 1.0), (4, 1 / 16, 4.0), (16, 1 / 64, 16.0), (64, -1e-3, 64.0)]
    for error, count in [(4.0, 0.25), (0.25, 2), (1 / 32, 8), (1 / 256, 64)]:
        equal, seconds, _ = metrics.equal_tracing(error, 1.0, traced)
        assert equal == pytest.approx(count)
        assert seconds == pytest.approx(count)
    for count, error in [(2, 0.25), (8, 1 / 32), (64, 1 / 256)]:
        assert metrics.equal_tracing(1.0, float(count), traced)[2] == pytest.approx(
            error
        )
    steep = traced[:2]
    assert metrics.equal_tracing(1 / 256, 16.0, steep)[0] == pytest.approx(16)
    # It is as little below what fewer rays had as measured, and never above.
    risen = [*steep, (16, 0.5, 16.0)]
    assert metrics.equal_tracing(1.0, 16.0, risen)[2] == pytest.approx(1 / 16)
    sunk = [(n, -1.0, t) for n, _, t in traced]
    assert np.isnan(metrics.equal_tracing(0.1, 1.0, sunk)).all()


@pytest.mark.parametrize(("error", "counts"), [(0.0, (1, 4)), (0.1, (4, 4)), (0.1, ())])
def test_tracing_beside_nothing_is_refused(error, counts):
    with pytest.raises(InputError, match="give two counts, an MSE over 0"):
        metrics.equal_tracing(error, 1.0, [(n, 1.0, 1.0) for n in counts])

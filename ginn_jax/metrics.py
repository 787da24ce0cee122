"""How far an image or a shaded cloud is from its reference, on the host in float64.

Two conventions hold throughout. An optional `mask` restricts a number to the pixels
or points where it is True. Images are linear until `tone_map`; `dssim` takes
tone-mapped ones.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from skimage.metrics import structural_similarity

from ginn_jax.checks import real_array
from ginn_jax.errors import InputError

GAMMA = 1.6
PERCENTILE = 90
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # Rec. 709, linear RGB
# SSIM as in Wang et al. 2004: Gaussian window, 11 wide; K1 = .01, K2 = .03, range 1.
SSIM_SIGMA, SSIM_WINDOW = 1.5, 11
RESAMPLES = 4000  # by the bootstrap
# Logarithm of so many times the counts and errors that were measured.
FAR = 100.0

Image = Float[np.ndarray, "..."]
Mask = Bool[np.ndarray, "..."]


def mse(a: Image, b: Image, mask: Mask | None = None) -> float:
    """Mean squared difference of two equal shapes, channels counted alike.

    `mask` has the leading axes of `a`: [H W] for [H W] or [H W C], [N] for a cloud.
    Raises `InputError` for unequal shapes or nothing to average.
    """
    a, b = _pair(a, b)
    difference = (a - b) ** 2
    return float(_kept(difference, mask).mean())


def true_mse(
    prediction: Image, target: Image, variance: Image, mask: Mask | None = None
) -> float:
    """MSE against what a noisy target estimates: `mse` less the noise floor.

    `variance` is the Monte Carlo variance of `target` (`reference.Estimate.variance`)
    of the same shape. Unbiased when the noise is independent of the prediction, thus
    it may come out slightly negative.
    """
    target, variance = _pair(target, variance)
    return mse(prediction, target, mask) - float(_kept(variance, mask).mean())


def relative_error(error: float, variance: float) -> float:
    """An MSE over the variance of its target, both with the noise subtracted.

    0 is perfect; predicting the mean of the target everywhere scores 1. To pool several
    clouds divide the means of both. NaN where the target is constant up to noise, which
    gives the error no scale.
    """
    return error / variance if variance > 0 else float("nan")


def pooled_interval(
    errors: Sequence[float], variances: Sequence[float]
) -> tuple[float, float]:
    """Where 95 % of the pooled relative errors lie of as many clouds drawn anew.

    Drawn from these with repetition (the bootstrap), always the same draws: how much of
    the ratio of the means is chance of which clouds there are. NaN for fewer than two.
    """
    count = len(errors)
    if count < 2:
        return float("nan"), float("nan")
    rows = np.random.default_rng(0).integers(0, count, (RESAMPLES, count))
    above, below = (np.asarray(a, np.float64)[rows].sum(1) for a in (errors, variances))
    low, high = np.percentile(above / below, (2.5, 97.5))
    return float(low), float(high)


def median_known(values: Sequence[float]) -> float:
    """The median of those that are not NaN; NaN where none is."""
    known = [value for value in values if not np.isnan(value)]
    return float(np.median(known)) if known else float("nan")


def equal_rays(error: float, per_ray_variance: float) -> float:
    """Rays a pixel at which ray tracing has the MSE `error`: their variance over it.

    `per_ray_variance` is the mean over pixels of the variance of one ray, for AO
    p(1-p): `rays * estimate.variance.mean()`. Infinite for an error of zero or less.
    """
    if not (np.isfinite(error) and 0 <= per_ray_variance < np.inf):
        raise InputError(f"equal rays of MSE {error}, variance {per_ray_variance}")
    return float(per_ray_variance) / float(error) if error > 0 else float("inf")


def equal_tracing(
    error: float, seconds: float, traced: Sequence[tuple[int | float, float, float]]
) -> tuple[float, float, float]:
    """What ray tracing comes to beside a method of this MSE and time.

    `traced` are the count of rays or paths a pixel, MSE and time of two runs at least.
    Between counts an MSE is taken to fall as a power of the count, before them as 1 /
    count, after them as between the last two, at least as 1 / count; one below 0, as
    noise that is subtracted can make it, is left out (NaN if all are). Times are taken
    to be a line, a flat one where what is measured does not grow.

    Returns the count and the time at equal MSE, and the ratio of the MSEs, tracing over
    the method's, at equal time: at one ray where there is time for less, at the most
    rays measured where the line is flat and there is time.
    """
    if len({count for count, _, _ in traced}) < 2 or not error > 0:
        raise InputError(f"tracing beside MSE {error}: give two counts, an MSE over 0")
    counts, errors, times = np.array(sorted(traced), np.float64).T
    if not (errors > 0).any():
        return np.nan, np.nan, np.nan
    n, e = _fall(counts[errors > 0], errors[errors > 0])
    slope, start = np.polyfit(counts, times, 1)
    if slope <= 0:
        slope, start = 0.0, times.mean()
    flat = counts[-1] if seconds >= start else 1.0
    affordable = max((seconds - start) / slope, 1.0) if slope > 0 else flat
    equal = float(np.exp(np.interp(-np.log(error), -e, n)))
    at_equal_time = np.exp(np.interp(np.log(affordable), n, e))
    return equal, float(start + slope * equal), float(at_equal_time / error)


def _fall(
    counts: Float[np.ndarray, "K"], errors: Float[np.ndarray, "K"]
) -> tuple[Float[np.ndarray, "P"], Float[np.ndarray, "P"]]:
    """Logarithms of counts and MSEs that never rise, with one point far off at either
    end."""
    n, e = np.log(counts), np.log(np.minimum.accumulate(errors))
    last = (e[-2] - e[-1]) / (n[-1] - n[-2]) if len(n) > 1 else 1.0
    far = np.array([FAR])
    n = np.concatenate([n[:1] - far, n, n[-1:] + far])
    return n, np.concatenate([e[:1] + far, e, e[-1:] - max(last, 1.0) * far])


def foreground(reference: Image) -> Mask:
    """Pixels that hold something in a reference; all where none does."""
    held = (reference.sum(-1) if reference.ndim == 3 else reference) > 0
    return held | ~held.any()


def tone_map(image: Image, reference: Image, mask: Mask | None = None) -> Image:
    """Linear [H W] or [H W 3] to display values in [0, 1], after the paper's appendix.

    Scaled so that the .9 luminance percentile of `reference` (over `mask`) becomes 1,
    clipped, then raised to 1/1.6. Map both images of a pair with the same reference.
    A reference that is black there leaves the scale at 1.
    """
    image, reference = (
        real_array("image", x).astype(np.float64) for x in (image, reference)
    )
    colour = reference.ndim == 3 and reference.shape[-1] == 3
    luminance = _kept(reference @ LUMINANCE if colour else reference, mask)
    white = np.percentile(luminance, PERCENTILE)
    scaled = image / white if white > 0 else image
    return np.clip(scaled, 0, 1) ** (1 / GAMMA)


def dssim(a: Image, b: Image, mask: Mask | None = None) -> float:
    """(1 - SSIM) / 2 of two images [H W] or [H W C] in [0, 1]: 0 equal, at most 1.

    Channels are averaged. Without a mask, the average leaves out the 5 pixels at each
    border, where the window overlaps it (scikit-image's). With one, background is set
    to 0 in both images and the average is over the mask, borders included.
    Raises `InputError` for unequal shapes or images under 11 pixels a side.
    """
    a, b = _pair(a, b)
    if a.ndim not in (2, 3) or min(a.shape[:2]) < SSIM_WINDOW:
        raise InputError(f"image {a.shape}: DSSIM needs [H W] or [H W C], 11 pixels up")
    _kept(a - b, mask)  # for its checks
    if mask is not None:
        mask = np.asarray(mask)
        keep = mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim))
        a, b = np.where(keep, a, 0), np.where(keep, b, 0)
    result: Any = structural_similarity(
        a,
        b,
        data_range=1,
        channel_axis=2 if a.ndim == 3 else None,
        gaussian_weights=True,
        sigma=SSIM_SIGMA,
        use_sample_covariance=False,
        full=True,
    )
    similarity = result[0] if mask is None else _kept(result[1], mask).mean()
    return float((1 - similarity) / 2)


def _pair(a: Image, b: Image) -> tuple[Image, Image]:
    """Both in float64 and of one shape."""
    a, b = (real_array("an array", x).astype(np.float64) for x in (a, b))
    if a.shape != b.shape:
        raise InputError(f"shapes {a.shape} and {b.shape} differ: give two equal ones")
    return a, b


def _kept(values: Image, mask: Mask | None) -> Image:
    """The values where the mask, over their leading axes, is True; finite ones."""
    if mask is not None:
        mask = np.asarray(mask)
        if mask.dtype != bool or mask.shape != values.shape[: mask.ndim]:
            raise InputError(
                f"mask {mask.dtype}{mask.shape} does not fit {values.shape}"
            )
        values = values[mask]
    if values.size == 0:
        raise InputError("nothing to average: the mask or the array is empty")
    if not np.isfinite(values).all():
        raise InputError("values to compare are not finite: mend or mask them out")
    return values

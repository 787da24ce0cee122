"""References of shots, and tracing as a rival: plain and denoised."""

import importlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ginn_jax import evaluate, lit_views
from ginn_jax.compare import Picture, Shot, Truth, Values, errors, with_truth
from ginn_jax.dataset import load_arrays, save_arrays
from ginn_jax.errors import InputError
from ginn_jax.estimates import ColorEstimate
from ginn_jax.evaluate import Row, View, timed
from ginn_jax.lit_views import LitView
from ginn_jax.reference import Estimate
from ginn_jax.scenes import Occlusion, Settings

# Of the denoiser: its default, and the quickest; what a row's name says of them.
QUALITIES = {"High": "", "Fast": " fast"}


def trace(
    shot: Shot, settings: Settings, count: int, *, stratified: bool = False, seed: int
) -> Truth:
    """Ray or path tracing of the pixels with `count` each."""
    drawn: Any = {"stratified": stratified, "seed": seed}
    if isinstance(shot, View):
        assert isinstance(settings, Occlusion)
        return evaluate.traced(shot, settings.radius, count, **drawn)
    return lit_views.traced(shot, count, **drawn)


def with_reference(
    shot: Shot, settings: Settings, count: int, path: Path, origin: Row, *, seed: int
) -> Shot:
    """The shot with its reference, traced once and kept at `path`."""
    try:
        found = load_arrays(path, origin)
    except InputError:
        truth = trace(shot, settings, count, seed=seed)
        found = {"mean": truth.mean, "variance": truth.variance}
        path.parent.mkdir(parents=True, exist_ok=True)
        save_arrays(path, found, origin)
    kind = Estimate if isinstance(shot, View) else ColorEstimate
    return with_truth(shot, kind(**found))


def traced_rows(
    shot: Shot, settings: Settings, counts: Sequence[int], units: Any, *, seed: int
) -> list[Row]:
    """Tracing with each number of rays or paths a pixel, plain and denoised."""
    rows = []
    for count in counts:
        noisy = traced_picture(shot, settings, count, units, seed=seed)
        rows.append(noisy.row)
        for quality in QUALITIES:
            if denoised := denoised_picture(shot, noisy, units, quality):
                rows.append(denoised.row)
    return rows


def traced_picture(
    shot: Shot, settings: Settings, count: int, units: Any, *, seed: int
) -> Picture:
    """Ray or path tracing with so many rays or paths a pixel, stratified."""
    work = partial(trace, shot, settings, count, stratified=True, seed=seed)
    truth, seconds = timed(work)
    what = "rays" if isinstance(shot, View) else "paths"
    row = {"method": f"{count} {what}", "traced": count, "seconds": seconds}
    return Picture(row | errors(shot, truth.mean, units), truth.mean)


def denoised_picture(
    shot: Shot, noisy: Picture, units: Any, quality: str
) -> Picture | None:
    """A traced picture after Open Image Denoise, guided by albedo and normals.

    None where the optional package `mitsuba_oidn` is not installed.
    """
    try:
        oidn = importlib.import_module("mitsuba_oidn")
    except ImportError:
        return None
    gbuffer = shot.gbuffer
    mask, (color, albedo) = gbuffer.mask, denoiser_inputs(shot, noisy.values)
    guides = {"albedo": albedo, "normal": gbuffer.normal.astype(np.float32)}
    hdr = isinstance(shot, LitView)
    how = {"hdr": hdr, "clean_aux": True, "quality": oidn.Quality[quality]}
    image, seconds = timed(partial(oidn.denoise, color, **guides, **how))
    image = np.asarray(image)
    values = (image[..., 0] if isinstance(shot, View) else image)[mask]
    row = {
        "method": f"{noisy.row['method']}, denoised{QUALITIES[quality]}",
        "denoised": noisy.row["traced"],
        "seconds": noisy.row["seconds"] + seconds,
    }
    return Picture(row | errors(shot, values, units), values)


def denoiser_inputs(
    shot: Shot, values: Values
) -> tuple[Float[np.ndarray, "H W 3"], Float[np.ndarray, "H W 3"]]:
    """Noisy image and albedo, in colour; the transported light, as the networks' is."""
    mask = shot.gbuffer.mask
    if isinstance(shot, View):
        gray = evaluate.fill(mask, values, evaluate.OPEN)
        color = np.repeat(gray[..., None], 3, axis=2)
        return color, evaluate.fill(mask, np.ones((len(values), 3), np.float32))
    albedo = shot.pixels.albedo[shot.pixels.material].astype(np.float32)
    color = evaluate.fill(mask, values)
    return color, evaluate.fill(mask, albedo)

"""Every method on the same pixels: networks, screen space, path tracing, denoising.

A shot is one scene under one camera, of ambient occlusion (`View`) or of light
(`LitView`). A method makes a picture of it: a row of numbers and the foreground values.
"""

import importlib
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from ginn_jax import evaluate, evaluate_light
from ginn_jax.architecture import Network
from ginn_jax.camera import Camera
from ginn_jax.checkpoint import load_weights
from ginn_jax.dataset import ShadedPoints, load_arrays, save_arrays
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model, Row, View, timed
from ginn_jax.evaluate_light import LitView
from ginn_jax.geometry import Limits
from ginn_jax.image import (
    BLOCK,
    encode_cloud,
    encode_whole,
    only,
    shade_block,
    shade_points,
    within_range,
    without,
)
from ginn_jax.irradiance import ColorEstimate
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.lit_scenes import Illumination, Lit, Scattering
from ginn_jax.mesh import Mesh
from ginn_jax.neighbors import bucket
from ginn_jax.pretrained import load_pretrained
from ginn_jax.receptive_field import Oriented
from ginn_jax.reference import Estimate
from ginn_jax.scenes import Occlusion, Settings
from ginn_jax.screen_bounce import bitmask_irradiance, indirect_irradiance
from ginn_jax.screen_occlusion import ambient_occlusion, bitmask_occlusion
from ginn_jax.screen_scattering import radiant_exitance

Shot = View | LitView
Stage = Mesh | Lit
Trained = tuple[Network, Limits, Model]
Truth = Estimate | ColorEstimate
Values = Float[np.ndarray, "P *C"]

OURS = "ours"
NETWORKS = {OURS: "", "2D only": "_only_2d", "3D only": "_only_3d"}


class Picture(NamedTuple):
    """What a method made of a shot: numbers, and values of the foreground."""

    row: Row
    values: Values


def load_networks(
    effect: str, runs: Sequence[Path | None], *, key: Key[Array, ""]
) -> dict[str, Trained]:
    """Our network of an effect and its ablations, of finished runs or, for None, those
    that come with the package."""
    networks = {}
    for (name, ending), run in zip(NETWORKS.items(), runs, strict=True):
        config, limits, weights = (
            load_pretrained(effect + ending) if run is None else load_weights(run)
        )
        networks[name] = config.network, limits, Model(weights, key)
    return networks


def take_shot(stage: Stage, camera: Camera, settings: Settings, *, seed: int) -> Shot:
    """A scene seen by a camera, with no reference yet."""
    if isinstance(stage, Mesh):
        return evaluate.frame(stage, camera)
    assert not isinstance(settings, Occlusion)
    return evaluate_light.lit_frame(stage, camera, settings, seed=seed)


def trace(shot: Shot, settings: Settings, count: int, *, seed: int) -> Truth:
    """Ray or path tracing of the pixels with `count` each."""
    if isinstance(shot, View):
        assert isinstance(settings, Occlusion)
        return evaluate.traced(shot, settings.radius, count, seed=seed)
    return evaluate_light.traced(shot, count, seed=seed)


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


def with_truth(shot: Shot, truth: Truth) -> Shot:
    """The shot with a reference."""
    if isinstance(shot, View):
        assert isinstance(truth, Estimate)
        return evaluate.with_truth(shot, truth)
    assert isinstance(truth, ColorEstimate)
    return evaluate_light.with_truth(shot, truth)


def target_of(shot: Shot) -> Values:
    """The reference of the foreground pixels."""
    if isinstance(shot, View):
        return shot.reference[shot.gbuffer.mask]
    return shot.pixels.target


def errors(shot: Shot, values: Values, units: Float[np.ndarray, "C"] | None) -> Row:
    """2D errors of a picture; `units` are those of the light, see `evaluate_light`."""
    if isinstance(shot, View):
        row = evaluate.image_errors(shot, evaluate.fill(shot.gbuffer.mask, values))
    else:
        assert units is not None
        row = evaluate_light.lit_image_errors(shot, values, units)
    return row | relative_error(shot, row)


def relative_error(shot: Shot, row: Row) -> Row:
    """The error of a row over the variance of the reference, and that variance."""
    variance = row.get("variance_2d")
    if isinstance(shot, View):
        noise = float(np.mean(shot.variance))
        variance = float(np.var(target_of(shot))) - noise
    return {"variance_2d": variance, "relative_mse_2d": row["mse_2d"] / variance}


def network_picture(
    name: str,
    trained: Trained,
    cloud: ShadedPoints | LitCloud,
    shot: Shot,
    scale: float = 1.0,
) -> tuple[Picture, Trained]:
    """A network's picture, and the network with the limits that it took."""
    network, limits, model = trained
    given = network, limits, model, cloud, shot, scale
    if isinstance(shot, View):
        row, image, limits = evaluate.network_row(*given)  # type: ignore[arg-type]
        values = image[shot.gbuffer.mask]
    else:
        row, values, _, limits = evaluate_light.lit_network_row(*given)  # type: ignore[arg-type]
    row |= {"method": name} | relative_error(shot, row)
    return Picture(row, values), (network, limits, model)


def network_values(
    trained: Trained, cloud: ShadedPoints | LitCloud, shot: Shot
) -> tuple[Values, Trained]:
    """What a network makes of the pixels, not timed."""
    network, limits, model = trained
    given = network, limits, model.variables
    mask = shot.gbuffer.mask
    pixels = shot.gbuffer.position[mask], shot.gbuffer.normal[mask]
    if isinstance(cloud, ShadedPoints):
        ends = cloud.position, cloud.normal
        encoded, limits = encode_cloud(*given, *ends, key=model.key)
        values, limits = shade_points(
            network, limits, model.variables, encoded, *pixels
        )
    else:
        assert isinstance(shot, LitView)
        encoded, limits = evaluate_light.encode_lit(network, limits, model, cloud)
        numbers = network_numbers(shot.pixels)
        values, limits = shade_points(
            network, limits, model.variables, encoded, *pixels, *numbers
        )
    return within_range(encoded, values), (network, limits, model)


def screen_pictures(
    shot: Shot, camera: Camera, settings: Settings, units: Any
) -> list[Picture]:
    """What screen-space methods make of the G-buffer."""
    mask, found = shot.gbuffer.mask, []
    for name, (method, images, static) in screen_methods(shot, settings).items():
        static = tuple({"camera": camera, **static}.items())
        shapes = tuple((image.shape, image.dtype) for image in images)
        compiled = compiled_screen(method, static, shapes)
        image, _, seconds = timed(partial(compiled, *images), repeats=1)
        values = np.asarray(image)[mask]
        row = {"method": name, "seconds": seconds} | errors(shot, values, units)
        row["memory_mib"] = scratch_mib(compiled)
        found.append(Picture(row, values))
    return found


@cache
def compiled_screen(
    method: Callable, static: tuple[tuple[str, Any], ...], shapes: tuple
) -> Any:
    """A screen-space method compiled for one camera and one size of images."""
    images = [jax.ShapeDtypeStruct(*shape) for shape in shapes]
    return jax.jit(partial(method, **dict(static))).lower(*images).compile()


def screen_methods(
    shot: Shot, settings: Settings
) -> dict[str, tuple[Callable, tuple[np.ndarray, ...], dict[str, Any]]]:
    """The screen-space methods of the effect: function, images, Python numbers."""
    position, normal, _, mask = shot.gbuffer
    surface = position, normal, mask
    if isinstance(shot, View):
        assert isinstance(settings, Occlusion)
        static = {"radius": settings.radius}
        return {
            "screen space": (ambient_occlusion, surface, static),
            "visibility bitmask": (bitmask_occlusion, surface, static),
        }
    pixels = shot.pixels
    irradiance = evaluate_light.fill(mask, pixels.irradiance)
    if isinstance(settings, Scattering):
        extinction, ior = (float(x) for x in pixels.medium)
        albedo = tuple(pixels.albedo[0].tolist())
        static = {"albedo": albedo, "extinction": extinction, "ior": ior}
        return {"screen space": (radiant_exitance, (*surface, irradiance), static)}
    albedo = evaluate_light.fill(mask, pixels.albedo[pixels.material])
    images = *surface, np.asarray(albedo * irradiance, np.float32)
    return {
        "screen space": (indirect_irradiance, images, {}),
        "visibility bitmask": (bitmask_irradiance, images, {}),
    }


def network_memory(trained: Trained, points: int) -> float:
    """Scratch memory of f_3D on so many points and of f_2D on a block on every device.

    What f_3D hands to f_2D is counted, inputs and outputs are not.
    """
    network, limits, model = trained

    def shapes(rows: int, asked: bool) -> Any:
        place = jax.ShapeDtypeStruct((rows, 3), np.float32)
        ends = Oriented(place, place, jax.ShapeDtypeStruct((rows,), bool))
        widths = (network.materials, network.lights) if asked else (0, 0)
        numbers = (
            jax.ShapeDtypeStruct((3, rows, width), np.float32) if width else None
            for width in widths
        )
        return ends, *numbers

    deep = network, without(limits, network.query.name)
    given = model.variables, *shapes(bucket(points), True), model.key
    compiled = encode_whole.lower(*deep, *given).compile()
    encoded, _ = jax.eval_shape(partial(encode_whole, *deep), *given)
    kept = sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(encoded.code))
    flat = network, only(limits, network.query.name), model.variables
    block = shapes(BLOCK, network.asks == "all")
    shaded = shade_block.lower(*flat, encoded, *block).compile()
    blocks = len(jax.devices()) * scratch_mib(shaded)
    return max(scratch_mib(compiled), blocks) + kept / 2**20


def scratch_mib(compiled: Any) -> float:
    """Memory that a compiled function asks for beside its inputs and outputs."""
    return compiled.memory_analysis().temp_size_in_bytes / 2**20


def traced_picture(
    shot: Shot, settings: Settings, count: int, units: Any, *, seed: int
) -> Picture:
    """Ray or path tracing with so many rays or paths a pixel."""
    work = partial(trace, shot, settings, count, seed=seed)
    truth, _, seconds = timed(work, repeats=1)
    what = "rays" if isinstance(shot, View) else "paths"
    row = {"method": f"{count} {what}", "traced": count, "seconds": seconds}
    return Picture(row | errors(shot, truth.mean, units), truth.mean)


def denoised_picture(shot: Shot, noisy: Picture, units: Any) -> Picture | None:
    """A traced picture after Open Image Denoise, guided by albedo and normals.

    None where the optional package `mitsuba_oidn` is not installed.
    """
    try:
        denoise = importlib.import_module("mitsuba_oidn").denoise
    except ImportError:
        return None
    gbuffer = shot.gbuffer
    mask, (color, albedo) = gbuffer.mask, denoiser_inputs(shot, noisy.values)
    guides = {"albedo": albedo, "normal": gbuffer.normal.astype(np.float32)}
    hdr = isinstance(shot, LitView)
    work = partial(denoise, color, **guides, hdr=hdr, clean_aux=True)
    image, _, seconds = timed(work)
    image = np.asarray(image)
    values = (image[..., 0] if isinstance(shot, View) else image)[mask]
    row = {
        "method": f"{noisy.row['method']}, denoised",
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
        gray = evaluate.fill(mask, values)
        color = np.repeat(gray[..., None], 3, axis=2)
        return color, evaluate_light.fill(mask, np.ones((len(values), 3), np.float32))
    albedo = shot.pixels.albedo[shot.pixels.material].astype(np.float32)
    color = evaluate_light.fill(mask, values)
    return color, evaluate_light.fill(mask, albedo)


def effect_settings(effect: str, points: int, paths: int, radius: float) -> Settings:
    """The settings of an effect by its short name."""
    kinds: dict[str, Any] = {
        "ao": partial(Occlusion, radius=radius),
        "gi": Illumination,
        "sss": Scattering,
    }
    return kinds[effect](points, paths)

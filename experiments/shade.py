"""Shade a mesh of yours, or a scan: one image, no reference.

    python -m experiments.shade --mesh chair.obj
    python -m experiments.shade --effect gi --mesh chair.obj --envmap sky.hdr
    python -m experiments.shade --scan scan.ply

Leaves image.png and values.npy: openness, indirect irradiance (GI) or radiant exitance
(SSS); of a scan, which is points with normals, the points shaded. `--help` lists every
option with its default.
"""

import io
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, TypeVar

import jax
import numpy as np
import trimesh
from jaxtyping import Float
from matplotlib.image import imsave

from ginn_jax import compare, lit_views
from ginn_jax.camera import Camera, orbit_camera
from ginn_jax.checks import number, positive
from ginn_jax.commandline import hasten, require, start
from ginn_jax.compare_networks import Trained
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model
from ginn_jax.files import write_whole
from ginn_jax.image import as_openness, shade_image
from ginn_jax.inference import encode_cloud, shade_points
from ginn_jax.irradiance import light_scene
from ginn_jax.lighting import load_environment, procedural_environment
from ginn_jax.lit_clouds import DENSE
from ginn_jax.lit_scenes import Lit, lit_points, lit_samples
from ginn_jax.mesh import Mesh
from ginn_jax.metrics import tone_map
from ginn_jax.objects import UNSEEN_SEED, object_or_shape
from ginn_jax.pretrained import load_network
from ginn_jax.reference import build_scene, render_gbuffer
from ginn_jax.samples import add_ground_samples, fit_unit_box_points, load_points
from ginn_jax.scenes import Occlusion, Settings
from ginn_jax.upsample import shading_step
from ginn_jax.visible import visible_samples

Made = TypeVar("Made")
Write = Callable[[io.BytesIO], Any]
# Values, and what writes the file that shows them.
Shaded = tuple[np.ndarray, Write]


@dataclass(frozen=True)
class Options:
    """Shade a mesh or a scan."""

    effect: Literal["ao", "gi", "sss"] = "ao"
    """Ambient occlusion, global illumination or subsurface scattering."""
    out: Path = Path("runs/shade")
    """Folder for image.png and values.npy, or shaded.ply."""
    mesh: Path | None = None
    """A mesh file, y up; left out, a procedural shape."""
    scan: Path | None = None
    """Occlusion: a PLY file of points with normals, y up, in place of a mesh."""
    envmap: Path | None = None
    """An environment map (HDR, EXR); left out, a procedural sky."""
    checkpoint: str | None = None
    """The --out of a run, or a name as "ao_fine"; left out, the effect's network."""
    albedo: tuple[float, float, float] = (0.7, 0.4, 0.25)
    """Albedo of the object."""
    ground_albedo: tuple[float, float, float] = (0.5, 0.5, 0.5)
    """GI: albedo of the ground."""
    extinction: float = 60.0
    """SSS: extinction of the medium, in units of 1 / the longest side of the object."""
    ior: float = 1.3
    """SSS: index of refraction, 1 to 1.5."""
    azimuth: float = 35.0
    """Where the camera stands, in degrees from +z towards +x."""
    elevation: float = 25.0
    """Its height over the horizon, in degrees."""
    resolution: int = 512
    """Side of the image in pixels."""
    resolution_scale: float = 1.0
    """Shade at 1/2, 1/3 or 1/4 of the resolution and interpolate."""
    points: int | None = None
    """Samples of the object; left out, 64,000 for occlusion, 32,000 for light."""
    looks: int = 512
    """Directions of the direct light per sample and pixel."""
    seed: int = 0
    """Seed of everything."""
    quick: bool = False
    """A small image of few samples: to try things."""


QUICK = {"resolution": 64, "points": 4000, "looks": 32}
OF_IMAGES = ("azimuth", "elevation", "resolution", "resolution_scale", "points")


def main(options: Options) -> Path:
    """Shade it; returns the file that shows it."""
    check(options)
    config, limits, weights = load_network(options.effect, options.checkpoint)
    trained = config.network, limits, Model(weights, jax.random.key(options.seed))
    options.out.mkdir(parents=True, exist_ok=True)
    if options.scan is not None:
        values, shown = shade_scan(options, options.scan, trained)
        path = options.out / "shaded.ply"
    else:
        ground = options.effect != "sss"
        mesh = object_or_shape(options.mesh, UNSEEN_SEED + options.seed, ground)
        shade = shade_occlusion if options.effect == "ao" else shade_light
        values, shown = shade(options, mesh, trained)
        path = options.out / "image.png"
    write_whole(options.out / "values.npy", lambda file: np.save(file, values))
    write_whole(path, shown)
    print(path)
    return path


def check(options: Options) -> None:
    """Raise `InputError` for options that cannot be meant."""
    require(options, {"resolution": 32, "points": 1000, "looks": 1, "seed": 0})
    shading_step(options.resolution_scale)
    if options.scan is not None:
        check_scan(options)
    if options.effect == "ao" and options.envmap is not None:
        raise InputError("--envmap is light, occlusion has none: give another --effect")
    positive("--extinction", options.extinction, DENSE)
    number("--ior", options.ior, 1.0, 1.5)


def check_scan(options: Options) -> None:
    """Raise `InputError` for what a scan, of which no image is made, has no use for."""
    if options.mesh or options.effect != "ao":
        raise InputError("--scan is for occlusion, without --mesh: leave that out")
    usual = hasten(Options(quick=options.quick), QUICK)
    for name in OF_IMAGES:
        if getattr(options, name) != getattr(usual, name):
            option = "--" + name.replace("_", "-")
            raise InputError(f"{option} is of images, --scan makes none: leave it out")


def shade_occlusion(options: Options, mesh: Mesh, trained: Trained) -> Shaded:
    """Openness of every pixel."""
    network, limits, model = trained
    scene = build_scene(mesh)
    settings, camera = settings_of(options), camera_of(options)
    cloud = told("samples", visible_samples, scene, settings.points, options.seed)
    pixels = told("G-buffer", render_gbuffer, scene, camera)
    ends = network, limits, model.variables
    given = *ends, cloud.position, cloud.normal
    codes, _ = told("f_3D", partial(encode_cloud, key=model.key), *given)
    seen = codes, pixels.position, pixels.normal, pixels.mask
    shade = partial(shade_image, resolution_scale=options.resolution_scale)
    openness, _ = told("f_2D", shade, *ends, *seen)
    return openness, as_png(openness)


def shade_light(options: Options, mesh: Mesh, trained: Trained) -> Shaded:
    """Indirect irradiance or radiant exitance of every pixel; shown is the radiance."""
    settings, camera = settings_of(options), camera_of(options)
    assert not isinstance(settings, Occlusion)
    lit = lit_by(options, mesh)
    samples = told("samples", lit_samples, lit, settings.points, options.seed)
    look = partial(lit_points, seed=options.seed)
    cloud = told("their light", look, lit, samples, settings.looks)
    see = partial(lit_views.lit_frame, seed=options.seed)
    view = told("G-buffer and its light", see, lit, camera, settings)
    encode = partial(lit_views.encode_lit, merge_grey=True)
    codes, _ = told("f_3D", encode, *trained, cloud)
    seen = codes, view.gbuffer, lit_views.pixel_numbers(view)
    shade = partial(lit_views.shade_seen, scale=options.resolution_scale)
    image, _ = told("f_2D", shade, *trained, *seen)
    mask = view.gbuffer.mask
    image = np.broadcast_to(image, (*mask.shape, 3))  # of grey light there is one
    radiance = lit_views.displayed(view, image[mask])
    return image, as_png(tone_map(radiance, radiance, mask))


def shade_scan(options: Options, path: Path, trained: Trained) -> Shaded:
    """Openness of the points of a scan, on ground; shown are the points in grey."""
    network, limits, model = trained
    scan = load_points(path)
    cloud = add_ground_samples(fit_unit_box_points(scan), seed=options.seed)
    ends = network, limits, model.variables
    given = *ends, cloud.position, cloud.normal
    codes, _ = told("f_3D", partial(encode_cloud, key=model.key), *given)
    own = slice(len(scan.position))
    asked = codes, cloud.position[own], cloud.normal[own]
    openness, _ = told("f_2D", shade_points, *ends, *asked)
    openness = as_openness(openness)
    grey = np.repeat(np.round(255 * openness)[:, None], 3, axis=1).astype(np.uint8)
    points = trimesh.PointCloud(scan.position, colors=grey)
    return openness, lambda file: points.export(file, file_type="ply")


def settings_of(options: Options) -> Settings:
    """How many samples, and how often the light at each is looked at."""
    settings = compare.effect_settings(options.effect, options.points, 2, 0.1)
    return compare.with_looks(settings, options.looks)


def camera_of(options: Options) -> Camera:
    """Where the image is seen from."""
    size = options.resolution
    angles = options.azimuth, options.elevation
    return orbit_camera(*angles, width=size, height=size)


def lit_by(options: Options, mesh: Mesh) -> Lit:
    """The mesh of that material under that light."""
    albedo = np.array([options.albedo, options.ground_albedo], np.float32)
    medium = np.zeros(0)
    if options.effect == "sss":
        albedo, medium = albedo[:1], np.array([options.extinction, options.ior])
    light = procedural_environment(UNSEEN_SEED + options.seed)
    if options.envmap is not None:
        light = load_environment(options.envmap)
    return Lit(light_scene(mesh, albedo, light), albedo, medium)


def told(what: str, call: Callable[..., Made], *given: Any) -> Made:
    """What a call returns, saying how long it took."""
    begin = time.perf_counter()
    made = call(*given)
    print(f"{what}: {time.perf_counter() - begin:.2f} s", flush=True)
    return made


def as_png(image: Float[np.ndarray, "H W *C"]) -> Write:
    """Writes an image of values from 0 to 1."""
    return lambda file: imsave(file, image, cmap="gray", vmin=0, vmax=1, format="png")


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

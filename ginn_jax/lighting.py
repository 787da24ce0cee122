"""Lights: environment maps from files, procedural ones from a seed, point lights.

Radiance is linear RGB. An environment map is a latitude-longitude image: row 0 looks up
(+y), column u looks along (sin 2 pi u, -cos 2 pi u) in x and z, as in Mitsuba.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax import radiance_files
from ginn_jax.checks import LARGEST, LARGEST_SEED, number, vector, whole, wide_array
from ginn_jax.errors import InputError, naming
from ginn_jax.files import check_file, files_below
from ginn_jax.renderer import use_mitsuba

ENDINGS = (".hdr", ".exr", ".pfm")
HEIGHT = 256
EARTH = 0.3  # the albedo of the ground below the horizon, where sky models end


class EnvironmentMap(NamedTuple):
    """Radiance from every direction."""

    radiance: Float[np.ndarray, "H W 3"]


class PointLight(NamedTuple):
    """A light at a point, by its radiant intensity."""

    position: Float[np.ndarray, "3"]
    intensity: Float[np.ndarray, "3"]


Light = EnvironmentMap | PointLight


def find_environments(path: str | Path) -> list[Path]:
    """The environment maps in a folder and those below it, sorted; or the one file.

    Raises `InputError` where there is no such file or folder, or no map in it.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: no such file or folder; give environment maps")
    if path.is_file():
        return [path]
    found = files_below(path, ENDINGS)
    if not found:
        raise InputError(f"{path}: no {', '.join(ENDINGS)} in this folder")
    return found


def load_environment(path: str | Path) -> EnvironmentMap:
    """A latitude-longitude map in any format Mitsuba reads, at most 256 rows high.

    Larger maps are averaged down, which keeps the irradiance. Raises `InputError` where
    the file is missing or unreadable, or its radiance negative, not finite or all zero.
    """
    path = Path(path)
    check_file(path, "an environment map")
    if not radiance_files.is_sound(path.read_bytes()):
        raise InputError(f"{path}: cannot be read (damaged); export it anew")
    mi, variant = use_mitsuba()
    with mi.variant_context(variant):
        try:
            bitmap = mi.Bitmap(str(path))
            kind = mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32
            pixels = np.array(bitmap.convert(*kind, srgb_gamma=False))
        except Exception as error:  # its readers raise what they like
            reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
            raise InputError(f"{path}: cannot be read ({reason})") from None
    with naming(str(path)):
        return make_environment(pixels)


def make_environment(radiance: Float[np.ndarray, "H W 3"]) -> EnvironmentMap:
    """A map from its pixels, checked and averaged down to 256 rows by solid angle.

    Whole numbers are radiance as they are: divide 8-bit pixels and undo their gamma.
    """
    radiance = _checked_radiance(radiance)
    if radiance.max() == 0:
        raise InputError("radiance is zero everywhere: the map is empty")
    height, width = radiance.shape[:2]
    if height > HEIGHT:
        rows = _averaging(height, HEIGHT, lambda share: -np.cos(np.pi * share))
        columns = _averaging(width, max(round(width * HEIGHT / height), 1))
        radiance = np.einsum("iu,ujc->ijc", rows, radiance, optimize=True)
        radiance = np.einsum("jv,ivc->ijc", columns, radiance, optimize=True)
    return EnvironmentMap(radiance.astype(np.float32))


def check_light(light: Light) -> Light:
    """The light in float32 arrays, whatever type of number it came in.

    Raises `InputError` unless it is one that can be traced; it may be dark.
    """
    if isinstance(light, EnvironmentMap):
        return EnvironmentMap(_checked_radiance(light.radiance))
    if isinstance(light, PointLight):
        position = vector("light's position", light.position)
        intensity = vector("light's intensity", light.intensity)
        if not (intensity >= 0).all():
            raise InputError(f"light's intensity {light.intensity} is negative")
        return PointLight(*(a.astype(np.float32) for a in (position, intensity)))
    kind = type(light).__name__
    raise InputError(f"light is a {kind}: give an EnvironmentMap or a PointLight")


def _checked_radiance(radiance: Any) -> Float[np.ndarray, "H W 3"]:
    """The pixels of a map in float32, not negative and finite there."""
    radiance = wide_array("radiance", radiance)
    if radiance.ndim != 3 or radiance.shape[-1] != 3 or radiance.size == 0:
        raise InputError(f"an environment map is [H W 3], this is {radiance.shape}")
    if not (np.abs(radiance) <= LARGEST).all():
        raise InputError("radiance is not finite; mend those pixels")
    if radiance.min() < 0:
        raise InputError("radiance is negative; clip it at zero")
    return np.ascontiguousarray(radiance, np.float32)


def _averaging(
    many: int, few: int, measure: Callable[[np.ndarray], np.ndarray] = np.asarray
) -> Float[np.ndarray, "few many"]:
    """The shares that `many` equal parts of a length have in each of `few`.

    `measure` is of what lies before a place from 0 to 1, such as the solid angle.
    """
    edges, places = (measure(np.linspace(0, 1, n + 1)) for n in (few, many))
    ends = np.minimum(edges[1:, None], places[1:])
    shared = np.maximum(ends - np.maximum(edges[:-1, None], places[:-1]), 0)
    return shared / shared.sum(axis=1, keepdims=True)


def constant_sky(radiance: float = 1.0) -> EnvironmentMap:
    """The same radiance from everywhere."""
    number("radiance", radiance, 0.0)
    return EnvironmentMap(np.full((HEIGHT, 2 * HEIGHT, 3), radiance, np.float32))


def sun_and_sky(
    turbidity: float, direction: Float[np.ndarray, "3"], sun_scale: float = 1.0
) -> EnvironmentMap:
    """The clear sky of Hosek and Wilkie with its sun, above ground of albedo .3.

    `direction` points to the sun, y up, which is not below the horizon; `turbidity` is
    from 1 to 10. The map is the mean of 2 x 2 directions a pixel, closer than the sun
    is wide, so that it is never missed.
    """
    number("turbidity", turbidity, 1.0, 10.0)
    number("sun_scale", sun_scale, 0.0)
    x, y, z = vector("direction", direction)
    if not (y >= 0 and x * x + y * y + z * z > 0):
        raise InputError(f"direction {direction} is below the horizon or zero: lift it")
    mi, variant = use_mitsuba()
    import drjit as dr

    fine = pixel_directions(2 * HEIGHT)
    with mi.variant_context(variant):
        emitter = mi.load_dict(
            {
                "type": "sunsky",
                "turbidity": float(turbidity),
                "sun_direction": [float(x) for x in direction],
                "sun_scale": float(sun_scale),
                "albedo": EARTH,
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90),
            }
        )
        interaction = dr.zeros(mi.SurfaceInteraction3f, fine.size // 3)
        interaction.wi = mi.Vector3f(np.ascontiguousarray(-fine.reshape(-1, 3).T))
        values = np.array(emitter.eval(interaction)).T.reshape(fine.shape)
    sky = make_environment(np.nan_to_num(np.maximum(values, 0.0)))
    below = pixel_directions(HEIGHT)[..., 1] < 0
    bounced = EARTH * irradiance_of(sky, np.array([0.0, 1.0, 0.0])) / np.pi
    radiance = np.where(below[..., None], bounced, sky.radiance)
    return EnvironmentMap(radiance.astype(np.float32))


def studio(seed: int) -> EnvironmentMap:
    """A dim room with one to six soft lamps of any size, colour and place."""
    rng = np.random.default_rng((whole("seed", seed, 0, LARGEST_SEED), 1))
    toward = pixel_directions(HEIGHT)
    tint = rng.uniform(0.5, 1.0, (2, 3)) * rng.uniform(0.02, 0.5, (2, 1))
    height = (toward[..., 1:2] + 1) / 2
    radiance = tint[0] * height + tint[1] * (1 - height)
    for _ in range(rng.integers(1, 7)):
        centre = rng.normal(size=3)
        centre[1] = abs(centre[1]) if rng.random() < 0.8 else centre[1]
        centre /= np.linalg.norm(centre)
        size = np.exp(rng.uniform(np.log(0.03), np.log(0.8)))
        angle = np.arccos(np.clip(toward @ centre, -1.0, 1.0))
        edge = np.exp(rng.uniform(np.log(0.02), np.log(0.5))) * size
        shape = 1 / (1 + np.exp(np.clip((angle - size) / edge, -60, 60)))
        colour = rng.uniform(0.3, 1.0, 3) * np.exp(rng.uniform(-1.0, 1.0))
        radiance = radiance + shape[..., None] * colour / (1 - np.cos(size))
    return EnvironmentMap(radiance.astype(np.float32))


def procedural_environment(seed: int) -> EnvironmentMap:
    """An outdoor sky or a studio, another for every seed, turned at random."""
    rng = np.random.default_rng((whole("seed", seed, 0, LARGEST_SEED), 0))
    if rng.random() < 0.5:
        light = studio(seed)
    else:
        elevation = np.arcsin(rng.uniform(np.sin(0.05), np.sin(1.4)))
        light = sun_and_sky(
            rng.uniform(1.5, 10.0),
            np.array([0.0, np.sin(elevation), np.cos(elevation)]),
            sun_scale=rng.choice([0.0, 0.1, 1.0], p=[0.2, 0.3, 0.5]),
        )
    return turned(light, rng.random())


def turned(light: EnvironmentMap, share: float) -> EnvironmentMap:
    """The map turned about the vertical by a share of a whole turn."""
    columns = round(number("share", share, -LARGEST) * light.radiance.shape[1])
    return EnvironmentMap(np.roll(light.radiance, columns, axis=1))


def pixel_directions(height: int) -> Float[np.ndarray, "H W 3"]:
    """Directions of the pixel centres of a map that is twice as wide as high."""
    theta = (np.arange(height) + 0.5) / height * np.pi
    phi = (np.arange(2 * height) + 0.5) / height * np.pi
    down, around = np.meshgrid(theta, phi, indexing="ij")
    return np.stack(
        [
            np.sin(around) * np.sin(down),
            np.cos(down),
            -np.cos(around) * np.sin(down),
        ],
        axis=-1,
    )


def irradiance_of(
    light: EnvironmentMap, normal: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3"]:
    """Irradiance of an unshadowed surface, by the sum over all pixels."""
    height, width = light.radiance.shape[:2]
    if width != 2 * height:
        raise InputError(f"an environment map is twice as wide as high, not {width}")
    cosine = np.maximum(pixel_directions(height) @ normal, 0.0)
    edges = np.cos(np.linspace(0, np.pi, height + 1))
    solid = (edges[:-1] - edges[1:])[:, None] * (2 * np.pi / width)
    return np.sum(light.radiance * (cosine * solid)[..., None], axis=(0, 1))

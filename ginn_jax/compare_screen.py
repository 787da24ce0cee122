"""What screen-space methods make of a shot."""

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from ginn_jax.camera import Camera
from ginn_jax.compare import Picture, Shot, errors, scratch_mib
from ginn_jax.evaluate import View, fill, timed
from ginn_jax.lit_scenes import Scattering
from ginn_jax.scenes import Occlusion, Settings
from ginn_jax.screen_bounce import bitmask_irradiance, indirect_irradiance
from ginn_jax.screen_occlusion import ambient_occlusion, bitmask_occlusion
from ginn_jax.screen_scattering import radiant_exitance


def screen_pictures(
    shot: Shot, camera: Camera, settings: Settings, units: Any
) -> list[Picture]:
    """What screen-space methods make of the G-buffer."""
    mask, found = shot.gbuffer.mask, []
    for name, (method, images, static) in screen_methods(shot, settings).items():
        static = tuple({"camera": camera, **static}.items())
        shapes = tuple((image.shape, image.dtype) for image in images)
        compiled = compiled_screen(method, static, shapes)
        image, seconds = timed(partial(compiled, *images))
        values = np.asarray(image)[mask]
        row = {"method": name, "seconds": seconds} | errors(shot, values, units)
        row["memory_mib"] = scratch_mib(compiled)
        found.append(Picture(row, values))
    return found


# Enough for the views of a scene; what they hold of memory maps is let go with them.
@lru_cache(maxsize=64)
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
    irradiance = fill(mask, pixels.irradiance)
    if isinstance(settings, Scattering):
        extinction, ior = (float(x) for x in pixels.medium)
        albedo = tuple(pixels.albedo[0].tolist())
        static = {"albedo": albedo, "extinction": extinction, "ior": ior}
        return {"screen space": (radiant_exitance, (*surface, irradiance), static)}
    albedo = fill(mask, pixels.albedo[pixels.material])
    images = *surface, np.asarray(albedo * irradiance, np.float32)
    return {
        "screen space": (indirect_irradiance, images, {}),
        "visibility bitmask": (bitmask_irradiance, images, {}),
    }

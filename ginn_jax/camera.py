"""Pinhole cameras: where they stand, what they look at, and a ray for each pixel."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ginn_jax.checks import LARGEST, MOST_PIXELS, number, positive, vector, whole
from ginn_jax.errors import InputError


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; `vertical_fov` in degrees, row 0 of the image is its top.

    Raises `InputError` when it has no pixels, no field of view or no view direction.
    """

    origin: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float] = (0.0, 1.0, 0.0)
    vertical_fov: float = 35.0
    width: int = 512
    height: int = 512

    def __post_init__(self) -> None:
        width = whole("camera's width", self.width, 1, MOST_PIXELS)
        whole("camera's height", self.height, 1, MOST_PIXELS // width)
        if not 0 < number("camera's vertical_fov", self.vertical_fov, 0.0, 180.0) < 180:
            raise InputError(
                f"camera's vertical_fov {self.vertical_fov} must be inside (0, 180)"
            )
        for name in ("origin", "target", "up"):
            vector(f"camera's {name}", getattr(self, name))
        forward = np.subtract(self.target, self.origin)
        least = 1e-6 * np.linalg.norm(forward) * np.linalg.norm(self.up)
        if not np.linalg.norm(np.cross(forward, self.up)) > least:
            raise InputError("camera looks along its up, or nowhere: move origin or up")


def orbit_camera(
    azimuth: float = 35.0,
    elevation: float = 25.0,
    distance: float = 2.2,
    *,
    target: tuple[float, float, float] = (0.0, 0.0, 0.0),
    vertical_fov: float = 35.0,
    width: int = 512,
    height: int = 512,
) -> Camera:
    """A camera on a sphere round `target`: a unit box on its ground fills the view.

    `azimuth` is measured from +z towards +x and `elevation` from the horizon, both in
    degrees (elevation strictly between -90 and 90); `distance` in box sides.
    """
    number("azimuth", azimuth, -LARGEST)
    if not -90 < number("elevation", elevation, -90.0, 90.0) < 90:
        raise InputError(f"elevation {elevation} looks along up: stay inside (-90, 90)")
    positive("distance", distance)
    vector("target", target)
    a, e = np.radians(azimuth), np.radians(elevation)
    away = np.array([np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)])
    x, y, z = (np.asarray(target) + distance * away).tolist()
    return Camera(
        (x, y, z), target, vertical_fov=vertical_fov, width=width, height=height
    )


def pixel_directions(camera: Camera) -> Float[np.ndarray, "P 3"]:
    """Unit directions through the pixel centres, row by row from the top left."""
    forward = np.subtract(camera.target, camera.origin)
    right = np.cross(forward, camera.up)
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    half = np.tan(np.radians(camera.vertical_fov) / 2)
    x = (2 * np.arange(camera.width) + 1 - camera.width) / camera.height * half
    y = (camera.height - 1 - 2 * np.arange(camera.height)) / camera.height * half
    up = np.cross(right, forward)
    d = forward + y[:, None, None] * up + x[None, :, None] * right
    return (d / np.linalg.norm(d, axis=-1, keepdims=True)).reshape(-1, 3)

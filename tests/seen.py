"""Analytic scenes for screen-space methods: planes and boxes seen by any camera."""

from functools import cache
from typing import NamedTuple

import jax
import numpy as np

from ginn_jax.camera import Camera, orbit_camera, pixel_directions


class Seen(NamedTuple):
    """A G-buffer with which of the parts each pixel sees (-1: none), and its camera."""

    position: np.ndarray
    normal: np.ndarray
    mask: np.ndarray
    part: np.ndarray
    camera: Camera

    @property
    def surface(self):
        return self.position, self.normal, self.mask


def see(camera, *boxes):
    """Boxes (low corner, high corner) through pixel centres, by slabs."""
    rays = pixel_directions(camera)
    origin = np.array(camera.origin)
    nearest, part = np.full(len(rays), np.inf), np.full(len(rays), -1)
    normal = np.zeros_like(rays)
    with np.errstate(divide="ignore", invalid="ignore"):
        for k, (low, high) in enumerate(boxes):
            ends = (np.array([low, high])[:, None] - origin) / rays
            enter, leave = ends.min(0), ends.max(0)
            axis, t = enter.argmax(1), enter.max(1)
            hit = (t < leave.min(1)) & (t > 0) & (t < nearest)
            facing = -np.eye(3)[axis] * np.sign(rays)
            nearest, part = np.where(hit, t, nearest), np.where(hit, k, part)
            normal = np.where(hit[:, None], facing, normal)
    mask = part >= 0
    position = origin + np.where(mask, nearest, 0)[:, None] * rays
    position = np.where(mask[:, None], position, 0)
    shape = camera.height, camera.width
    return Seen(
        position.reshape(*shape, 3).astype(np.float32),
        normal.reshape(*shape, 3).astype(np.float32),
        mask.reshape(shape),
        part.reshape(shape),
        camera,
    )


@cache
def compiled(method, camera, *options):
    """A method under jit, for one camera and (name, value) pairs: compiled once."""
    return jax.jit(lambda *images: method(*images, camera=camera, **dict(options)))


FLOOR = ((-5.0, -1.0, -5.0), (5.0, 0.0, 5.0))
WALL = ((-5.0, 0.0, -1.0), (5.0, 5.0, 0.0))


def corner(size, azimuth=0.0):
    """The floor y = 0 and the wall z = 0, seen from the room in front."""
    camera = orbit_camera(azimuth, 35.0, 2.0, width=size, height=size)
    return see(camera, FLOOR, WALL)

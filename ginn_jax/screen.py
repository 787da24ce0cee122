"""What screen-space methods share: a G-buffer in the camera's own coordinates.

x is right, y down and z the depth along the view direction, so that columns grow with
x / z and rows with y / z. Depth is looked up inverted: over a plane, 1 / z is affine in
the pixel, so a pixel's normal carries its depth exactly to any place inside it, and
the background is simply 0. The camera is known when a program is compiled, as are the
counts and lengths that a method takes: they are static arguments under `jax.jit`.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ginn_jax.camera import Camera
from ginn_jax.checks import LARGEST_INDEX, real_array, whole
from ginn_jax.errors import InputError

# A pixel's depth changes over its width by at most so many widths: at a silhouette its
# tangent plane says nothing about what is seen beside it.
STEEPEST = 8.0


class Screen(NamedTuple):
    """Positions, unit normals in the camera's coordinates, and the foreground.

    `focal` is the distance of the image plane in pixels, `rays` the direction through
    each pixel's centre at depth 1. Background positions lie at depth 1.
    """

    position: Float[Array, "H W 3"]
    normal: Float[Array, "H W 3"]
    mask: Bool[Array, "H W"]
    rays: Float[Array, "H W 3"]
    focal: float


def enter_screen(
    position: Float[Any, "H W 3"],
    normal: Float[Any, "H W 3"],
    mask: Bool[Any, "H W"],
    camera: Camera,
) -> Screen:
    """A G-buffer in the coordinates of the camera that rendered it.

    Raises `InputError` where the shapes are not those of one image of that camera, or
    the mask is not of truth values.
    """
    shape, mask = (camera.height, camera.width), jnp.asarray(mask)
    if mask.shape != shape:
        raise InputError(
            f"mask {mask.shape} is not of the camera's {shape}: give its G-buffer"
        )
    if mask.dtype != bool:
        raise InputError(f"mask is {mask.dtype}: give bool")
    check_images(shape, position=position, normal=normal)
    axes, origin = view_axes(camera), np.asarray(camera.origin, np.float32)
    focal = camera.height / 2 / float(np.tan(np.radians(camera.vertical_fov) / 2))
    x = (np.arange(camera.width) + 0.5 - camera.width / 2) / focal
    y = (np.arange(camera.height) + 0.5 - camera.height / 2) / focal
    rays = np.stack([*np.meshgrid(x, y), np.ones(shape)], axis=-1).astype(np.float32)
    inside = mask[..., None]
    seen = turn(jnp.asarray(position, jnp.float32) - origin, axes)
    # A foreground pixel is in front of the camera, whatever rounding says.
    seen = jnp.where(inside & (seen[..., 2:] > 1e-6), seen, rays)
    facing = turn(jnp.asarray(normal, jnp.float32), axes)
    return Screen(seen, jnp.where(inside, facing, -rays), mask, jnp.array(rays), focal)


def check_images(shape: tuple[int, ...], **images: Any) -> None:
    """Raise `InputError` unless every image is [H W 3] of that shape."""
    for name, image in images.items():
        if jnp.shape(image) != (*shape, 3):
            raise InputError(f"{name} {jnp.shape(image)} must be {(*shape, 3)}")


def check_counts(**counts: int) -> None:
    """Raise `InputError` unless every count is a whole number from 1 on."""
    for name, count in counts.items():
        whole(name, count, 1, LARGEST_INDEX)


def check_pairs(directions: int) -> None:
    """Raise `InputError` unless directions pair up to slices."""
    if directions % 2:
        raise InputError(f"directions {directions} must be even: a slice has two")


def check_above_zero(**numbers: float) -> None:
    """Raise `InputError` unless every number is above 0 (it may be infinite)."""
    for name, number in numbers.items():
        array = real_array(name, number)
        if array.ndim or not array > 0:
            raise InputError(f"{name} {number} must be a number above 0")


def view_axes(camera: Camera) -> Float[np.ndarray, "3 3"]:
    """Rows: right, down and forward as unit vectors of the world."""
    forward = np.subtract(camera.target, camera.origin)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, camera.up)
    right = right / np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward]).astype(np.float32)


def turn(
    vectors: Float[Array, "H W 3"], axes: Float[np.ndarray, "3 3"]
) -> Float[Array, "H W 3"]:
    """Components along three axes, at full precision on any device."""
    return jnp.sum(vectors[..., None, :] * axes, axis=-1)


def dot(a: Float[Array, "*S 3"], b: Float[Array, "*S 3"]) -> Float[Array, "*S"]:
    """Scalar product of the last axis."""
    return jnp.sum(a * b, axis=-1)


def inverse_depths(screen: Screen) -> Float[Array, "P 3"]:
    """1 / z of every pixel and its change per column and row; a frame of background.

    The table of `look_up`: (H + 2) (W + 2) rows, 0 where nothing is.
    """
    nearness = 1 / screen.position[..., 2]
    offset = dot(screen.normal, screen.position)
    offset = jnp.where(jnp.abs(offset) > 1e-6, offset, -1e-6)
    slope = screen.normal[..., :2] / offset[..., None] / screen.focal
    steepest = STEEPEST * nearness[..., None] / screen.focal
    slope = jnp.clip(slope, -steepest, steepest)
    table = jnp.concatenate([nearness[..., None], slope], axis=-1)
    return framed(jnp.where(screen.mask[..., None], table, 0.0))


def framed(image: Float[Array, "H W C"]) -> Float[Array, "P C"]:
    """An image with a frame of zeros, pixel by pixel."""
    around = jnp.pad(image, ((1, 1), (1, 1), (0, 0)))
    return around.reshape(-1, image.shape[-1])


def look_up(
    table: Float[Array, "P 3"],
    column: Float[Array, "H W"],
    row: Float[Array, "H W"],
) -> tuple[Float[Array, "H W"], Float[Array, "H W 3"], Int[Array, "H W"]]:
    """1 / z at any place of the image (0: nothing), its change, its place in a table.

    Whole numbers are pixel centres; a table is what `framed` makes. The change is per
    column and row, with a third component of 0.
    """
    height, width = column.shape
    j = jnp.clip(jnp.round(column), -1, width)
    i = jnp.clip(jnp.round(row), -1, height)
    place = ((i + 1) * (width + 2) + j + 1).astype(jnp.int32)
    nearness, across, down = jnp.moveaxis(table[place], -1, 0)
    nearness = nearness + across * (column - j) + down * (row - i)
    return nearness, jnp.stack([across, down, jnp.zeros_like(down)], -1), place


def pixel_places(
    shape: tuple[int, ...],
) -> tuple[Float[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Column and row of every pixel's centre."""
    rows, columns = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    return columns, rows


def gradient_noise(shape: tuple[int, ...]) -> Float[np.ndarray, "H W"]:
    """A fixed pattern in [0, 1) whose neighbours differ (Jimenez 2014)."""
    columns, rows = np.indices(shape)[::-1].astype(np.float64)
    inner = (0.06711056 * columns + 0.00583715 * rows) % 1
    return (52.9829189 * inner % 1).astype(np.float32)

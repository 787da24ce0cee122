"""Clouds in colour as they lie on disk, and the monochrome clouds a network sees.

On disk a point takes 35 bytes: its position as it is, its normal by octahedral
coordinates of 16 bits, light by half-precision numbers in units of their mean.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ginn_jax.dataset import (
    ShadedPoints,
    another_kind,
    check_rows,
    load_arrays,
    save_arrays,
)

LARGEST_HALF = 65504.0
LIGHTS = ("irradiance", "target", "variance")
# Mean free paths in the length of an object beyond which nothing is seen to change: no
# medium is denser. Extinctions e go in by log(1 + e) / log(1 + this).
DENSE = 500.0


class LitCloud(NamedTuple):
    """Points with the direct light on them and what they are shaded to, in RGB.

    `albedo[k]` is that of material k, of diffuse reflection or, where there is a
    `medium` (extinction, index of refraction), of subsurface scattering.
    """

    position: Float[np.ndarray, "N 3"]
    normal: Float[np.ndarray, "N 3"]
    material: Int[np.ndarray, "N"]
    irradiance: Float[np.ndarray, "N 3"]
    target: Float[np.ndarray, "N 3"]
    variance: Float[np.ndarray, "N 3"]
    albedo: Float[np.ndarray, "K 3"]
    medium: Float[np.ndarray, "P"]


Cloud = ShadedPoints | LitCloud


def channel_of(cloud: Cloud, channel: int) -> ShadedPoints:
    """One colour of a cloud as the network takes it; a cloud without colour as it is.

    Diffuse reflection takes the light that surfaces send out, albedo times irradiance,
    to which the indirect light is proportional; scattering takes the irradiance.
    """
    if isinstance(cloud, ShadedPoints):
        return cloud
    material, light = network_numbers(cloud, slice(channel, channel + 1))
    return ShadedPoints(
        cloud.position,
        cloud.normal,
        cloud.target[:, channel],
        cloud.variance[:, channel],
        material[0],
        light[0],
    )


def network_numbers(
    cloud: LitCloud, channels: slice = slice(3)
) -> tuple[Float[np.ndarray, "C N A"], Float[np.ndarray, "C N L"]]:
    """Material and light of every point, for each of these channels."""
    albedo = cloud.albedo[cloud.material, channels].T[..., None].astype(np.float32)
    irradiance = cloud.irradiance[:, channels].T[..., None]
    if cloud.medium.size == 0:
        return albedo, albedo * irradiance
    extinction, ior = cloud.medium
    shared = np.log1p(extinction) / np.log1p(DENSE), ior - 1
    rest = np.broadcast_to(np.array(shared, np.float32), (*albedo.shape[:2], 2))
    return np.concatenate([albedo, rest], axis=2), irradiance


def mean_light(cloud: LitCloud) -> Float[np.ndarray, "3"]:
    """Mean of the light that the network takes, the unit of each channel."""
    return network_numbers(cloud)[1][..., 0].mean(axis=1)


def unit_floor(clouds: Sequence[LitCloud]) -> float:
    """Mean noise of the targets in the unit of the training loss."""
    floors = []
    for cloud in clouds:
        scale = mean_light(cloud)
        lit = scale > 0
        floors += (cloud.variance.mean(axis=0)[lit] / scale[lit] ** 2).tolist()
    return float(np.mean(floors))


def split_points(cloud: LitCloud, count: int) -> tuple[LitCloud, LitCloud]:
    """The first `count` points, and the others."""
    return take_points(cloud, slice(count)), take_points(cloud, slice(count, None))


def take_points(cloud: LitCloud, rows: Any) -> LitCloud:
    """Some points of a cloud, by an index of their rows."""
    whole = {"albedo": cloud.albedo, "medium": cloud.medium}
    points = {n: a[rows] for n, a in cloud._asdict().items() if n not in whole}
    return LitCloud(**points, **whole)


def points_of(cloud: Cloud, rows: Any) -> Cloud:
    """Some points of a cloud of either kind."""
    if isinstance(cloud, LitCloud):
        return take_points(cloud, rows)
    return jax.tree.map(lambda a: a[rows], cloud)


def save_lit_cloud(path: Path, cloud: LitCloud, origin: dict[str, Any]) -> None:
    """Write a cloud in compact form and what made it, atomically."""
    arrays = cloud._asdict() | {
        "normal": to_octahedron(cloud.normal),
        "material": cloud.material.astype(np.uint8),
    }
    for name in LIGHTS:
        most = float(arrays[name].max(initial=0.0)) / LARGEST_HALF
        unit = max(float(np.mean(arrays[name], dtype=np.float64)), most, 1e-30)
        arrays[f"{name}_unit"] = np.float64(unit)
        arrays[name] = np.minimum(arrays[name] / unit, LARGEST_HALF).astype(np.float16)
    save_arrays(path, arrays, origin)


def load_lit_cloud(path: Path, origin: dict[str, Any] | None = None) -> LitCloud:
    """Read a cloud back; raises `InputError` as `dataset.load_cloud` does."""
    with another_kind(path):
        arrays = load_arrays(path, origin)
        for name in LIGHTS:
            unit = float(arrays.pop(f"{name}_unit"))
            arrays[name] = arrays[name].astype(np.float32) * np.float32(unit)
        arrays["normal"] = from_octahedron(arrays["normal"])
        arrays["material"] = arrays["material"].astype(np.int32)
        cloud = LitCloud(**arrays)
        check_rows(
            {n: a for n, a in arrays.items() if n not in ("albedo", "medium")},
            dict.fromkeys(("position", "normal", *LIGHTS), 3),
        )
        check_rows({"position": cloud.albedo}, {"position": 3})
        materials = cloud.material.max(initial=-1) + 1
        if materials > len(cloud.albedo) or cloud.medium.shape not in ((0,), (2,)):
            raise ValueError("material")
    return cloud


def to_octahedron(normal: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, "N 2"]:
    """Unit vectors by where they meet the octahedron, unfolded (Meyer et al. 2010)."""
    flat = normal / np.abs(normal).sum(axis=1, keepdims=True)
    plane = _fold(*flat.astype(np.float64).T)
    return np.round(plane * 32767).astype(np.int16)


def from_octahedron(code: Int[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """The unit vectors of `to_octahedron`, to about 1e-4."""
    x, y = code.T / 32767.0
    z = 1 - abs(x) - abs(y)
    found = np.concatenate([_fold(x, y, z), z[:, None]], axis=1)
    return (found / np.linalg.norm(found, axis=1, keepdims=True)).astype(np.float32)


def _fold(
    x: Float[np.ndarray, "N"], y: Float[np.ndarray, "N"], z: Float[np.ndarray, "N"]
) -> Float[np.ndarray, "N 2"]:
    """The lower half of the octahedron folded out of the plane, or into it."""
    folded = np.stack([(1 - abs(y)) * _sign(x), (1 - abs(x)) * _sign(y)], axis=1)
    return np.where(z[:, None] < 0, folded, np.stack([x, y], axis=1))


def _sign(x: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N"]:
    return np.where(x < 0, -1.0, 1.0)

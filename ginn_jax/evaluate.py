"""Errors of a trained network: at points, in images, and against run time."""

import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from ginn_jax.architecture import Network
from ginn_jax.camera import Camera, orbit_camera
from ginn_jax.dataset import ShadedPoints, count_given
from ginn_jax.image import as_openness, encode_cloud, shade_image, shade_points
from ginn_jax.limits import Limits
from ginn_jax.mesh import Mesh
from ginn_jax.metrics import (
    dssim,
    equal_rays,
    median_known,
    mse,
    relative_error,
    tone_map,
    true_mse,
)
from ginn_jax.network import Variables
from ginn_jax.reference import (
    Estimate,
    GBuffer,
    Scene,
    ambient_occlusion,
    build_scene,
    render_gbuffer,
)

Row = dict[str, Any]


class Model(NamedTuple):
    """A trained network's arrays; its table and capacities go beside it."""

    variables: Variables
    key: Key[Array, ""]


class View(NamedTuple):
    """One object seen by one camera, with the reference of its foreground pixels."""

    scene: Scene
    gbuffer: GBuffer
    reference: Float[np.ndarray, "H W"]
    variance: Float[np.ndarray, "P"]


def evaluate_clouds(
    network: Network,
    limits: Limits,
    model: Model,
    clouds: Sequence[ShadedPoints],
    names: Sequence[str],
    rays: int,
) -> tuple[list[Row], Limits]:
    """3D errors of every cloud, one row each. `rays` made the targets.

    The first four fifths of a cloud are the network's input, as in training, and the
    rest is where it is asked, so no point is both. Noise is subtracted: `mse` is
    against the expectation.
    """
    rows = []
    for name, cloud in zip(names, clouds, strict=True):
        given, asked = split_cloud(cloud)
        encoded, limits = encode_cloud(
            network,
            limits,
            model.variables,
            given.position,
            given.normal,
            key=model.key,
        )
        values, limits = shade_points(
            network, limits, model.variables, encoded, asked.position, asked.normal
        )
        noise = float(np.mean(asked.variance))
        raw = mse(as_openness(values), asked.target)
        spread = float(np.var(asked.target)) - noise
        rows.append(
            {
                "name": name,
                "points": int(np.sum(encoded.points.mask)),
                "raw_mse_3d": raw,
                "noise_floor_3d": noise,
                "mse_3d": raw - noise,
                "variance_3d": spread,
                "relative_mse_3d": relative_error(raw - noise, spread),
                "ray_variance": noise * rays,
            }
        )
    return rows, limits


def split_cloud(cloud: ShadedPoints) -> tuple[ShadedPoints, ShadedPoints]:
    """The points that a network is given, and those at which it is asked."""
    count = count_given(len(cloud.position))
    first = jax.tree.map(lambda a: a[:count], cloud)
    return first, jax.tree.map(lambda a: a[count:], cloud)


def pool_rows(rows: Sequence[Row]) -> Row:
    """Means over the clouds; the relative error is a ratio of means, not their mean."""
    names = ("raw_mse_3d", "mse_3d", "noise_floor_3d", "variance_3d", "ray_variance")
    pooled = {name: float(np.mean([row[name] for row in rows])) for name in names}
    return pooled | {
        "clouds": len(rows),
        "relative_mse_3d": relative_error(pooled["mse_3d"], pooled["variance_3d"]),
        "median_relative_mse_3d": median_known([r["relative_mse_3d"] for r in rows]),
        "equal_rays": equal_rays(pooled["mse_3d"], pooled["ray_variance"]),
    }


def reference_view(
    mesh: Mesh, radius: float, rays: int, seed: int, size: int, azimuth: float = 35.0
) -> View:
    """An object with its ray-traced ambient occlusion at every foreground pixel."""
    view = frame(mesh, orbit_camera(azimuth, width=size, height=size))
    return with_truth(view, traced(view, radius, rays, seed=seed))


def frame(mesh: Mesh, camera: Camera) -> View:
    """A mesh seen by a camera, with no reference yet."""
    scene = build_scene(mesh)
    gbuffer = render_gbuffer(scene, camera)
    nothing = np.zeros(int(gbuffer.mask.sum()), np.float32)
    return View(scene, gbuffer, fill(gbuffer.mask, nothing), nothing)


def traced(view: View, radius: float, rays: int, *, seed: int) -> Estimate:
    """Ray-traced ambient occlusion at the foreground pixels of a view."""
    mask = view.gbuffer.mask
    position, normal = view.gbuffer.position[mask], view.gbuffer.normal[mask]
    return ambient_occlusion(view.scene, position, normal, radius, rays=rays, seed=seed)


def with_truth(view: View, truth: Estimate) -> View:
    """The view with a reference."""
    reference = fill(view.gbuffer.mask, truth.mean)
    return view._replace(reference=reference, variance=truth.variance)


def fill(
    mask: Bool[np.ndarray, "H W"], values: Float[np.ndarray, "P"]
) -> Float[np.ndarray, "H W"]:
    """An image of the foreground values, open (1) elsewhere."""
    image = np.ones(mask.shape, np.float32)
    image[mask] = values
    return image


def image_errors(view: View, image: Float[np.ndarray, "H W"]) -> Row:
    """2D errors of the foreground: MSE less the noise, tone-mapped DSSIM."""
    mask, reference = view.gbuffer.mask, view.reference
    mine, right = (tone_map(i, reference, mask) for i in (image, reference))
    return {
        "mse_2d": true_mse(image[mask], reference[mask], view.variance),
        "dssim_2d": dssim(mine, right, mask),
    }


def timed(work: Callable[[], Any], repeats: int = 3) -> tuple[Any, float, float]:
    """Result, seconds of the first call (with compilation), median of the others."""
    seconds, result = [], None
    for _ in range(repeats + 1):
        start = time.perf_counter()
        result = jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return result, seconds[0], float(np.median(seconds[1:]))


def network_row(
    network: Network,
    limits: Limits,
    model: Model,
    cloud: ShadedPoints,
    view: View,
    scale: float = 1.0,
) -> tuple[Row, Float[np.ndarray, "H W"], Limits]:
    """Errors and times of the network on one object, its image, the limits it took.

    `scale` is the resolution scale of `shade_image`.
    """
    radius = network.levels[0]
    arguments = (cloud.position, cloud.normal)
    _, limits = encode_cloud(
        network, limits, model.variables, *arguments, key=model.key
    )
    (encoded, limits), _, deep = timed(
        lambda: encode_cloud(
            network, limits, model.variables, *arguments, key=model.key
        )
    )
    pixels = (view.gbuffer.position, view.gbuffer.normal, view.gbuffer.mask)

    def shade() -> tuple[Float[np.ndarray, "H W"], Limits]:
        arrays = model.variables, encoded, *pixels
        return shade_image(network, limits, *arrays, resolution_scale=scale)

    _, limits = shade()
    (image, limits), _, flat = timed(shade)
    lower = f", scale {scale:g}" if scale < 1 else ""
    row = {
        "method": f"network, disk {radius:g}{lower}",
        "disk_radius": radius,
        "points": int(np.sum(encoded.points.mask)),
        "seconds_3d": deep,
        "seconds_2d": flat,
        "seconds": deep + flat,
    }
    return row | image_errors(view, image), image, limits


def ray_row(view: View, radius: float, rays: int, seed: int) -> Row:
    """Error and time of ray-traced ambient occlusion at `rays` per pixel."""
    truth, _, seconds = timed(lambda: traced(view, radius, rays, seed=seed))
    row = {"method": f"{rays} rays", "rays": rays, "seconds": seconds}
    return row | image_errors(view, fill(view.gbuffer.mask, truth.mean))


def mean_rows(rows: Sequence[Row]) -> list[Row]:
    """Rows of the same method averaged over the objects, in order of appearance."""
    methods: dict[str, list[Row]] = {}
    for row in rows:
        methods.setdefault(row["method"], []).append(row)
    return [
        {"method": method, "objects": len(group)}
        | {
            name: float(np.mean([row[name] for row in group]))
            for name in group[0]
            if name not in ("method", "name")
        }
        for method, group in methods.items()
    ]

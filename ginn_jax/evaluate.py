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
from ginn_jax.errors import InputError
from ginn_jax.image import Encoded, as_openness, shade_image
from ginn_jax.inference import encode_cloud, shade_points
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
from ginn_jax.upsample import shading_step

Row = dict[str, Any]
Image = Float[np.ndarray, "H W *C"]
OPEN = 1.0  # a background that nothing occludes
NUMBERS = int, float, np.number


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

    The first four fifths of a cloud are the network's input, as in training, the rest
    is where it is asked. Noise is subtracted: `mse` is against the expectation.
    """
    rows = []
    for name, cloud in zip(names, clouds, strict=True):
        given, asked = split_cloud(cloud)
        ends = model.variables, given.position, given.normal
        encoded, limits = encode_cloud(network, limits, *ends, key=model.key)
        ends = model.variables, encoded, asked.position, asked.normal
        values, limits = shade_points(network, limits, *ends)
        noise = float(np.mean(asked.variance))
        raw = mse(as_openness(values), asked.target)
        spread = float(np.var(asked.target)) - noise
        rows.append(
            {
                "name": name,
                "points": int(np.sum(encoded.points.mask)),
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
    """Means over the clouds; the relative error is a ratio of means, not their mean.

    Clouds without light, whose errors have no unit, are left out and counted.
    """
    every, rows = len(rows), [row for row in rows if np.isfinite(row["mse_3d"])]
    if not rows:
        raise InputError("no light reaches any of the clouds to test on: choose others")
    names = ("mse_3d", "noise_floor_3d", "variance_3d", "ray_variance")
    pooled = {name: float(np.mean([row[name] for row in rows])) for name in names}
    return pooled | {
        "clouds": len(rows),
        "dark_clouds": every - len(rows),
        "relative_mse_3d": relative_error(pooled["mse_3d"], pooled["variance_3d"]),
        "median_relative_mse_3d": median_known([r["relative_mse_3d"] for r in rows]),
        "equal_rays": equal_rays(pooled["mse_3d"], pooled["ray_variance"]),
    }


def reference_view(mesh: Mesh, radius: float, rays: int, seed: int, size: int) -> View:
    """An object with its ray-traced ambient occlusion at every foreground pixel."""
    view = frame(mesh, orbit_camera(width=size, height=size))
    return with_truth(view, traced(view, radius, rays, seed=seed))


def frame(mesh: Mesh, camera: Camera) -> View:
    """A mesh seen by a camera, with no reference yet."""
    scene = build_scene(mesh)
    gbuffer = render_gbuffer(scene, camera)
    nothing = np.zeros(int(gbuffer.mask.sum()), np.float32)
    return View(scene, gbuffer, fill(gbuffer.mask, nothing, OPEN), nothing)


def traced(
    view: View, radius: float, rays: int, *, stratified: bool = False, seed: int
) -> Estimate:
    """Ray-traced ambient occlusion at the foreground pixels of a view."""
    mask = view.gbuffer.mask
    ends = view.scene, view.gbuffer.position[mask], view.gbuffer.normal[mask], radius
    return ambient_occlusion(*ends, rays=rays, stratified=stratified, seed=seed)


def with_truth(view: View, truth: Estimate) -> View:
    """The view with a reference."""
    reference = fill(view.gbuffer.mask, truth.mean, OPEN)
    return view._replace(reference=reference, variance=truth.variance)


def fill(
    mask: Bool[np.ndarray, "H W"],
    values: Float[np.ndarray, "P *C"],
    background: float = 0.0,
) -> Float[np.ndarray, "H W *C"]:
    """An image of the foreground values, `background` elsewhere."""
    image = np.full((*mask.shape, *values.shape[1:]), background, np.float32)
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


def timed(work: Callable[[], Any]) -> tuple[Any, float]:
    """Result, and the median of the seconds of three calls after a first one."""
    seconds, result = [], jax.block_until_ready(work())
    for _ in range(3):
        start = time.perf_counter()
        result = jax.block_until_ready(work())
        seconds.append(time.perf_counter() - start)
    return result, float(np.median(seconds))


def timed_network(
    limits: Limits,
    encode: Callable[[Limits], tuple[Encoded, Limits]],
    shade: Callable[[Limits, Encoded], tuple[Image, Limits]],
) -> tuple[Encoded, Image, Limits, Row]:
    """Codes, an image, the limits that sufficed, and the seconds of f_3D and f_2D."""
    _, limits = encode(limits)
    (encoded, limits), deep = timed(lambda: encode(limits))
    _, limits = shade(limits, encoded)
    (image, limits), flat = timed(lambda: shade(limits, encoded))
    times = {"seconds_3d": deep, "seconds_2d": flat, "seconds": deep + flat}
    points = int(np.sum(encoded.points.mask))
    return encoded, image, limits, {"points": points} | times


def at_scale(scale: float) -> str:
    """What the name of a method says of a resolution scale."""
    return f", scale 1/{shading_step(scale)}" if scale < 1 else ""


def network_row(
    network: Network,
    limits: Limits,
    model: Model,
    cloud: ShadedPoints,
    view: View,
    scale: float = 1.0,
) -> tuple[Row, Float[np.ndarray, "H W"], Limits]:
    """Errors and times of the network on one object, its image, the limits it took;
    `scale` is the resolution scale of `shade_image`."""
    pixels = view.gbuffer.position, view.gbuffer.normal, view.gbuffer.mask
    ends = model.variables, cloud.position, cloud.normal
    _, image, limits, times = timed_network(
        limits,
        lambda limits: encode_cloud(network, limits, *ends, key=model.key),
        lambda limits, encoded: shade_image(
            network, limits, model.variables, encoded, *pixels, resolution_scale=scale
        ),
    )
    method = f"network, disk {(radius := network.levels[0]):g}" + at_scale(scale)
    row = {"method": method, "disk_radius": radius} | times
    return row | image_errors(view, image), image, limits


def ray_row(view: View, radius: float, rays: int, seed: int) -> Row:
    """Error and time of stratified ray tracing with `rays` per pixel."""
    truth, spent = timed(lambda: traced(view, radius, rays, stratified=True, seed=seed))
    row = {"method": f"{rays} rays", "rays": rays, "seconds": spent}
    return row | image_errors(view, fill(view.gbuffer.mask, truth.mean, OPEN))


def mean_rows(rows: Sequence[Row]) -> list[Row]:
    """Means over the shots of each method; relative errors as ratios of means. Times
    are medians: in one shot the machine may have had other work."""
    methods: dict[str, list[Row]] = {}
    for row in rows:
        methods.setdefault(row["method"], []).append(row)
    means = []
    for method, group in methods.items():
        numbers = [k for k, v in group[0].items() if isinstance(v, NUMBERS)]
        middle = {k: np.median if k.startswith("seconds") else np.mean for k in numbers}
        mean = {k: float(middle[k]([row[k] for row in group])) for k in numbers}
        if "variance_2d" in mean:
            relative = relative_error(mean["mse_2d"], mean["variance_2d"])
            mean |= {"relative_mse_2d": relative}
        means.append({"method": method, "shots": len(group)} | mean)
    return means

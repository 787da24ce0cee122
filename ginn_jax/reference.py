"""Ground truth by ray tracing: ambient occlusion and the G-buffer of a camera.

Everything returned is NumPy; points and pixels go through the same functions. Mitsuba's
variant is process-global state: it is set inside each call and put back after it.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt

from ginn_jax.camera import Camera, pixel_directions
from ginn_jax.checks import LARGEST_SEED, positive, unit_rows, whole
from ginn_jax.draws import random_pair, stratified_pair
from ginn_jax.errors import InputError
from ginn_jax.mesh import Mesh, check_mesh
from ginn_jax.renderer import use_mitsuba

RAYS_PER_LAUNCH = 2**22
# Rays start this far off the surface, relative to the largest coordinate: about 160
# float32 rounding steps, so that a surface never shades itself.
OFFSET = 1e-5
# Within less than half of this, also relative to the largest coordinate, surfaces were
# measured to hide themselves: rays start a hundredth of the radius off them.
LEAST_RADIUS = 2e-5


class Estimate(NamedTuple):
    """A Monte Carlo mean and the unbiased variance of that mean, for each point."""

    mean: Float[np.ndarray, "N"]
    variance: Float[np.ndarray, "N"]


class Scene(NamedTuple):
    """A mesh and its ray tracing structure, made by `build_scene`."""

    mesh: Mesh
    handle: Any


class GBuffer(NamedTuple):
    """What each pixel sees; where `mask` is False (background) the rest is zero."""

    position: Float[np.ndarray, "H W 3"]
    normal: Float[np.ndarray, "H W 3"]
    material: Int[np.ndarray, "H W"]
    mask: Bool[np.ndarray, "H W"]


def ambient_occlusion(
    mesh: Mesh | Scene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    radius: float,
    *,
    rays: int,
    stratified: bool = False,
    seed: int,
) -> Estimate:
    """Openness: the cosine-weighted fraction of rays that travel `radius` unblocked.

    1 is open and 0 blocked (paper section 4.1, as openness). Each point casts `rays`
    independent rays, so the variance of the mean is p(1-p)/(rays-1), NaN for one ray.
    The rays of a point depend on `seed` (32 bits) and its place in `points` alone.

    With `stratified` they are spread evenly instead (see `stratified_pair`), every ray
    by itself still distributed as before: the error is less, but how large is not
    known, so the variance is NaN.

    Pass a `Scene` from `build_scene` to cast at the same mesh again. `normals` must be
    unit vectors of the surface the points lie on. Raises `InputError` on bad input.
    """
    scene = mesh if isinstance(mesh, Scene) else build_scene(mesh)
    points, normals = check_cast(scene, points, normals, radius, rays, seed)
    number = np.arange(len(points), dtype=np.uint32)
    ends = scene, points, normals, number
    blocked = count_blocked(*ends, radius, (0, rays), seed, stratified)
    p = 1 - blocked / rays
    known = rays > 1 and not stratified
    variance = p * (1 - p) / (rays - 1) if known else np.full_like(p, np.nan)
    return Estimate(p.astype(np.float32), variance.astype(np.float32))


def launches(
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    each: int,
    most: int,
) -> list[tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], int]]:
    """Points and normals in parts of at most `most` rays, `each` a point.

    With every part comes the number of its first point.
    """
    size = max(1, min(most // each, len(points)))
    starts = range(0, len(points), size)
    return [(points[i : i + size], normals[i : i + size], i) for i in starts]


def build_scene(mesh: Mesh) -> Scene:
    """The mesh, ready for rays; build it once for several calls on one mesh.

    Raises `InputError` for an empty or non-finite mesh, a face that names a vertex
    that is not there, or a machine without a usable libLLVM.
    """
    mesh = check_mesh(mesh)
    mi, variant = use_mitsuba()
    with mi.variant_context(variant):
        shape = mi.Mesh("mesh", len(mesh.vertices), len(mesh.faces))
        params = mi.traverse(shape)
        params["vertex_positions"] = mesh.vertices.ravel()
        params["faces"] = mesh.faces.astype(np.uint32).ravel()
        params.update()
        return Scene(mesh, mi.load_dict({"type": "scene", "mesh": shape}))


def count_blocked(
    scene: Scene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    number: UInt[np.ndarray, "N"],
    radius: float,
    cast: tuple[int, int],
    seed: int,
    stratified: bool = False,
) -> UInt[np.ndarray, "N"]:
    """How many of each point's rays hit something within `radius`.

    The rays of a point depend on its `number` and `seed`; those `cast` are from the
    first number to before the second, which `stratified` ones are spread for.
    """
    each = max(cast[1] - cast[0], 1)
    parts = []
    for place, normal, i in launches(points, normals, each, RAYS_PER_LAUNCH):
        own = number[i : i + len(place)]
        ends = scene, place, normal, own, radius, cast, seed
        parts.append(_count_of_launch(*ends, stratified))
    return np.concatenate([np.zeros(0, np.uint32), *parts])


def _count_of_launch(
    scene: Scene,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    number: UInt[np.ndarray, "n"],
    radius: float,
    cast: tuple[int, int],
    seed: int,
    stratified: bool,
) -> UInt[np.ndarray, "n"]:
    """`count_blocked` of as many points as are taken at a time.

    One lane a ray, so that the rays of a point are traced side by side. Numbers that
    change between calls are opaque, or each would compile a kernel of its own.
    """
    mi, variant = use_mitsuba()
    import drjit as dr

    rays = cast[1] - cast[0]
    largest = float(np.abs(scene.mesh.vertices).max())
    offset = min(OFFSET * largest, 0.01 * radius)
    start = np.asarray(points, np.float32) + np.float32(offset) * normals
    with mi.variant_context(variant):
        lane = dr.arange(mi.UInt32, len(points) * rays)
        point = lane // dr.opaque(mi.UInt32, rays)
        ray = lane - point * dr.opaque(mi.UInt32, rays) + dr.opaque(mi.UInt32, cast[0])
        own = dr.gather(mi.UInt32, mi.UInt32(number), point)
        draw = stratified_pair(cast[1]) if stratified else random_pair
        a, b = draw(own, ray, dr.opaque(mi.UInt32, seed))
        square = mi.Point2f(mi.Float(a >> 8) * 2**-24, mi.Float(b >> 8) * 2**-24)
        hemisphere = mi.warp.square_to_cosine_hemisphere(square)
        normal = dr.gather(mi.Normal3f, mi.Normal3f(columns(normals)), point)
        origin = dr.gather(mi.Point3f, mi.Point3f(columns(start)), point)
        shot = mi.Ray3f(origin, mi.Frame3f(normal).to_world(hemisphere))
        shot.maxt = dr.opaque(mi.Float, radius)
        blocked = dr.select(scene.handle.ray_test(shot), mi.UInt32(1), mi.UInt32(0))
        return dr.block_reduce(dr.ReduceOp.Add, blocked, rays).numpy()


def render_gbuffer(mesh: Mesh | Scene, camera: Camera) -> GBuffer:
    """Position, face normal (towards the camera) and material through pixel centres."""
    scene = mesh if isinstance(mesh, Scene) else build_scene(mesh)
    mi, variant = use_mitsuba()
    directions = pixel_directions(camera)
    with mi.variant_context(variant):
        ray = mi.Ray3f(mi.Point3f(*camera.origin), mi.Vector3f(columns(directions)))
        hit = scene.handle.ray_intersect_preliminary(ray)
        mask = hit.is_valid().numpy()
        face = np.where(mask, hit.prim_index.numpy(), 0)
        u, v = hit.prim_uv.numpy()[..., None]
    corner = np.asarray(scene.mesh.vertices, np.float64)[scene.mesh.faces[face]]
    edge_u, edge_v = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    normal = np.cross(edge_u, edge_v)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    normal *= np.where((normal * directions).sum(1, keepdims=True) > 0, -1, 1)
    position = corner[:, 0] + u * edge_u + v * edge_v
    shape = (camera.height, camera.width)
    zeroed = [
        np.where(mask[:, None], a, 0).reshape(*shape, 3) for a in (position, normal)
    ]
    material = np.where(mask, scene.mesh.material[face], 0).astype(np.int32)
    return GBuffer(
        zeroed[0].astype(np.float32),
        zeroed[1].astype(np.float32),
        material.reshape(shape),
        mask.reshape(shape),
    )


def columns(rows: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 n"]:
    """Rows as the renderer's vectors take them."""
    return np.ascontiguousarray(np.asarray(rows, np.float32).T)


def check_cast(
    scene: Scene, points: Any, normals: Any, radius: float, rays: int, seed: int
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, "N 3"]]:
    """Points and normals in float32 arrays.

    Raises `InputError` unless such rays can be cast from there in the scene.
    """
    points, normals = unit_rows(points, normals)
    positive("radius", radius)
    whole("rays", rays, 1, RAYS_PER_LAUNCH)
    whole("seed", seed, 0, LARGEST_SEED)
    largest = float(np.abs(scene.mesh.vertices).max())
    if radius < LEAST_RADIUS * largest:
        raise InputError(
            f"radius {radius:g} is too short for coordinates up to {largest:g}: give "
            f"at least {LEAST_RADIUS * largest:.3g}"
        )
    return points, normals

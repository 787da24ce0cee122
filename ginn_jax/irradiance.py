"""Ground truth of global illumination: direct and indirect irradiance by path tracing.

Points and pixels go through the same functions. All surfaces are diffuse; materials are
an RGB albedo for each material index of the mesh (0 object, 1 ground).
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax.checks import real_array, unit_rows
from ginn_jax.draws import random_pair
from ginn_jax.errors import InputError
from ginn_jax.estimates import (
    PATHS_PER_LAUNCH,
    ColorEstimate,
    check_draws,
    joined,
    lanes,
    sampler_of,
    summarize,
)
from ginn_jax.lighting import EnvironmentMap, Light, check_light
from ginn_jax.mesh import Mesh, check_mesh
from ginn_jax.reference import launches
from ginn_jax.renderer import use_mitsuba

# Fractional parts of multiples of these fill the square evenly (Roberts 2018, R2).
LATTICE = (0.7548776662466927, 0.5698402909980532)
# After EARLIEST bounces the integrator ends paths, each with a chance of 1 - KEEPING or
# more. Where more light than KEEPING comes back the weight of the others would grow
# without end, and the variance: there all but DARK has to be absorbed first.
KEEPING, EARLIEST, LATEST, DARK = 0.95, 5, 10_000, 1e-4


class LitScene(NamedTuple):
    """A mesh with materials under one light, made by `light_scene`.

    `bounces` is how many a path is certain to make where it meets something.
    """

    mesh: Mesh
    light: Light
    handle: Any
    bounces: int = EARLIEST


def light_scene(mesh: Mesh, albedo: Float[np.ndarray, "K 3"], light: Light) -> LitScene:
    """The scene that rays are traced in; `albedo[k]` is that of material k.

    Raises `InputError` for an albedo outside [0, 1] or a material without one, and for
    a mesh or a light that no renderer can take.
    """
    mesh = check_mesh(mesh)
    light = check_light(light)
    albedo = real_array("albedo", albedo).astype(np.float64)
    if albedo.ndim != 2 or albedo.shape[1] != 3 or not (albedo >= 0).all():
        raise InputError(f"albedo {albedo.shape} must be [K 3] and not negative")
    if not (albedo <= 1).all():
        raise InputError("an albedo above 1 would make light: give it in [0, 1]")
    if mesh.material.max() >= len(albedo):
        raise InputError(
            f"{len(albedo)} albedos for materials up to {mesh.material.max()}: give all"
        )
    mi, variant = use_mitsuba()
    with mi.variant_context(variant):
        parts: dict[str, Any] = {"type": "scene", "light": emitter(light)}
        used = np.unique(mesh.material).tolist()
        parts |= {f"material_{k}": _shape(mesh, k, albedo[k]) for k in used}
        bounces = _certain_bounces(albedo[used].max(initial=0.0))
        return LitScene(mesh, light, mi.load_dict(parts), bounces)


def _certain_bounces(albedo: float) -> int:
    """Bounces before a path may be ended at random, by the brightest surface."""
    if albedo <= KEEPING:
        return EARLIEST
    return int(np.ceil(np.log(DARK) / np.log(min(albedo, DARK ** (1 / LATEST)))))


def emitter(light: Light) -> dict[str, Any]:
    """The light as a Mitsuba dictionary; call it with the variant set."""
    mi, _ = use_mitsuba()
    if isinstance(light, EnvironmentMap):
        return {"type": "envmap", "bitmap": mi.Bitmap(light.radiance)}
    return {
        "type": "point",
        "position": [float(x) for x in light.position],
        "intensity": {"type": "rgb", "value": [float(x) for x in light.intensity]},
    }


def _shape(mesh: Mesh, material: int, albedo: Float[np.ndarray, "3"]) -> Any:
    """The faces of one material as a Mitsuba mesh with flat normals."""
    mi, _ = use_mitsuba()
    faces = mesh.faces[mesh.material == material]
    used, faces = np.unique(faces, return_inverse=True)
    color = {"type": "rgb", "value": [float(x) for x in albedo]}
    surface = {"type": "diffuse", "reflectance": color}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict({"type": "twosided", "surface": surface})
    shape = mi.Mesh("mesh", len(used), faces.size // 3, properties)
    params = mi.traverse(shape)
    params["vertex_positions"] = np.asarray(mesh.vertices[used], np.float32).ravel()
    params["faces"] = faces.astype(np.uint32).ravel()
    params.update()
    return shape


def direct_irradiance(
    scene: LitScene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    *,
    looks: int,
    seed: int,
) -> Float[np.ndarray, "N 3"]:
    """Irradiance that arrives from the light unbounced.

    Every point looks at the light in `looks` directions, drawn in proportion to its
    radiance from a lattice that is shifted at random; one is enough for a point light.
    """
    points, normals = unit_rows(points, normals)
    check_draws("looks", looks, seed)
    looks = looks if isinstance(scene.light, EnvironmentMap) else 1
    parts = [
        _direct(scene, *launch, looks, seed)
        for launch in launches(points, normals, looks, PATHS_PER_LAUNCH)
    ]
    return np.concatenate([np.zeros((0, 3), np.float32), *parts])


def _direct(
    scene: LitScene,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    first: int,
    looks: int,
    seed: int,
) -> Float[np.ndarray, "n 3"]:
    mi, variant = use_mitsuba()
    import drjit as dr

    with mi.variant_context(variant):
        point, ray, at, normal = lanes(scene.mesh, points, normals, looks)
        number = point + dr.opaque(mi.UInt32, first)
        shift = random_pair(number, mi.UInt32(0), dr.opaque(mi.UInt32, seed))
        # In words, whose multiples wrap around and stay exact however many they are.
        square = [
            mi.Float((s + ray * int(step * 2**32)) >> 8) * 2**-24
            for s, step in zip(shift, LATTICE, strict=True)
        ]
        square = mi.Point2f(*square)
        receiver = dr.zeros(mi.SurfaceInteraction3f, len(points) * looks)
        receiver.p, receiver.n = at, normal
        toward, radiance = scene.handle.sample_emitter_direction(
            receiver, square, test_visibility=False
        )
        cosine = dr.dot(toward.d, normal)
        above = (toward.pdf > 0) & (cosine > 0)
        cast = receiver.spawn_ray_to(toward.p)
        arrived = dr.select(above, radiance * cosine, 0)
        dr.eval(arrived, above, cast)
        arrived *= dr.select(_free(scene, cast, above), 1, 0)
        total = [dr.block_reduce(dr.ReduceOp.Add, c, looks) for c in arrived]
        return np.stack([c.numpy() for c in total], axis=1) / looks


def _free(scene: LitScene, cast: Any, asked: Any) -> Any:
    """Whether asked rays meet nothing; they are packed, so that others cost nothing."""
    mi, _ = use_mitsuba()
    import drjit as dr

    rows: Any = dr.compress(asked)
    free = asked & False
    if len(rows):
        blocked = scene.handle.ray_test(dr.gather(mi.Ray3f, cast, rows))
        dr.scatter(free, ~blocked, rows)
    return free


def indirect_irradiance(
    scene: LitScene,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    *,
    paths: int,
    stratified: bool = False,
    seed: int,
) -> ColorEstimate:
    """Irradiance by light that bounced at least once, all bounces.

    pi times the mean of `paths` cosine-distributed path-traced radiances (paper,
    section "Training Data Generation"); Mitsuba's `path` with hidden emitters.

    With `stratified` the paths of a point share out what they draw instead of being
    independent: the error is less, the variance not known, so NaN.
    """
    points, normals = unit_rows(points, normals)
    check_draws("paths", paths, seed, stratified)
    return joined(
        _indirect(scene, *launch, paths, seed, stratified)
        for launch in launches(points, normals, paths, PATHS_PER_LAUNCH)
    )


def _indirect(
    scene: LitScene,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    first: int,
    paths: int,
    seed: int,
    stratified: bool,
) -> ColorEstimate:
    mi, variant = use_mitsuba()
    with mi.variant_context(variant):
        _, _, at, normal = lanes(scene.mesh, points, normals, paths)
        sampler = sampler_of(len(points), paths, first, seed, stratified)
        local = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        cast = mi.Ray3f(at, mi.Frame3f(normal).to_world(local))
        kind = {"type": "path", "hide_emitters": True, "rr_depth": scene.bounces}
        integrator = mi.load_dict(kind)
        radiance, _, _ = integrator.sample(scene.handle, sampler, cast)
        return summarize(np.pi * radiance, paths, stratified)

"""Ground truth of subsurface scattering: random walks in a medium behind a boundary.

The faces of material 0 enclose a homogeneous, isotropically scattering medium behind a
smooth dielectric boundary. Light that enters is known by its irradiance E alone: the
boundary refracts it as if a radiance E / pi came from everywhere. So the exitance is a
linear function of the field of direct irradiance, which is all that a network is told.

Solids that overlap are filled as one: what is inside another is no boundary, and no
network could know of it, as only what light can reach is sampled. Light that a walk
would meet in a cavity is direct light, so a sealed one is dark.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax.checks import number, real_array, unit_rows
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
from ginn_jax.irradiance import LATTICE, LitScene
from ginn_jax.lighting import EnvironmentMap
from ginn_jax.reference import OFFSET, launches
from ginn_jax.renderer import use_mitsuba
from ginn_jax.slab import single_scattering_albedo

# A walk carries absorption as weight until then: least variance times run time among
# 0, 2, 8, 16 and 32 events, measured.
ROULETTE_AFTER = 8
# Walks cost more than shadow rays: 4 take .2 to .5 of the run time of 1 at the same
# variance, measured.
LIGHT_SAMPLES = 4


class Medium(NamedTuple):
    """What fills an object.

    `albedo` is the share of the light that entered a thick slab that leaves it again.
    `extinction` is the inverse of the mean free path where the object's longest side
    is 1: a material's extinction in 1/mm times the size of that side in mm. `ior` is
    the index of refraction relative to air.
    """

    albedo: Float[np.ndarray, "3"]
    extinction: float
    ior: float


def subsurface_exitance(
    scene: LitScene,
    medium: Medium,
    points: Float[np.ndarray, "N 3"],
    normals: Float[np.ndarray, "N 3"],
    *,
    paths: int,
    stratified: bool = False,
    seed: int,
) -> tuple[ColorEstimate, float]:
    """Radiant exitance of direct light that crossed the medium; share of lost walks.

    The mean of `paths` walks from each point back to where their light entered, with
    all orders of scattering and internal reflection. A walk is lost, and counts as
    dark, when it leaves the object through a hole or goes on for 1,000 + 4
    extinction^2 events, more than 30 times the slowest decay of light in a cube.

    With `stratified` the walks of a point share out what they draw instead of being
    independent: the error is less, the variance not known, so NaN.

    `points` lie on faces of material 0, whose `normals` point outward. Raises
    `InputError` on bad input.
    """
    points, normals = unit_rows(points, normals)
    _check_medium(medium)
    check_draws("paths", paths, seed, stratified)
    if not (scene.mesh.material == 0).any():
        raise InputError("the scene has no face of material 0 to enclose a medium")
    parts = [
        _exitance(scene, medium, *launch, paths, seed, stratified)
        for launch in launches(points, normals, paths, PATHS_PER_LAUNCH)
    ]
    lost = sum(count for _, count in parts) / max(len(points) * paths, 1)
    return joined(part for part, _ in parts), lost


def _check_medium(medium: Medium) -> None:
    """Raise `InputError` unless walks can be made in it."""
    albedo = real_array("albedo", medium.albedo)
    if albedo.shape != (3,) or not ((albedo >= 0) & (albedo <= 1)).all():
        raise InputError(f"albedo {albedo} must be three numbers in [0, 1]")
    number("extinction", medium.extinction, 0.0)
    number("index of refraction", medium.ior, 1.0, 2.0)


def _exitance(
    scene: LitScene,
    medium: Medium,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    first: int,
    paths: int,
    seed: int,
    stratified: bool,
) -> tuple[ColorEstimate, int]:
    """Exitance of some points, `first` the number of the first, and lost walks.

    Directions are cosine-distributed outside and refracted inward, so that no walk
    starts beyond the critical angle, and eta^2 at its start cancels that at its end.
    """
    mi, variant = use_mitsuba()
    import drjit as dr

    with mi.variant_context(variant):
        _, _, at, inward = lanes(scene.mesh, points, -normals, paths)
        sampler = sampler_of(len(points), paths, first, seed, stratified)
        outer = mi.warp.square_to_cosine_hemisphere(sampler.next_2d())
        ior = dr.opaque(mi.Float, medium.ior)
        x, y = outer.x / ior, outer.y / ior
        inner = mi.Vector3f(x, y, dr.safe_sqrt(1 - x * x - y * y))
        ray = mi.Ray3f(at, mi.Frame3f(inward).to_world(inner))
        weight = mi.Color3f(1 - mi.fresnel(outer.z, ior)[0])
        start = (ray, inward, weight, sampler)
        weight, at, normal, lost = _walk(scene, medium, *start)
        lit = dr.max(weight) > 0
        arrived = _irradiance(scene, at, normal, sampler, lit)
        arrived = dr.select(lit, weight * arrived, 0)
        dr.eval(arrived, lost)  # together, or each channel would walk anew
        return summarize(arrived, paths, stratified), int(lost.numpy().sum())


def _walk(
    scene: LitScene, medium: Medium, ray: Any, inward: Any, weight: Any, sampler: Any
) -> tuple[Any, Any, Any, Any]:
    """Each walk's weight, just outside where its light entered, normal there, lost.

    Numbers that change between calls are opaque, or each would compile a kernel.
    """
    mi, _ = use_mitsuba()
    import drjit as dr

    def opaque(values: Any) -> list[Any]:
        return [dr.opaque(mi.Float, float(x)) for x in values]

    alpha = mi.Color3f(opaque(single_scattering_albedo(medium.albedo, medium.ior)))
    margin = OFFSET * float(np.abs(scene.mesh.vertices).max())
    sigma, outside, offset = opaque([medium.extinction, 1 / medium.ior, margin])
    most = dr.opaque(mi.UInt32, int(min(1000 + 4 * medium.extinction**2, 2**31)))
    corner = scene.mesh.vertices[scene.mesh.faces[scene.mesh.material == 0]]
    low, high = corner.min((0, 1)) - margin, corner.max((0, 1)) + margin
    low, high = mi.Point3f(opaque(low)), mi.Point3f(opaque(high))
    solid = next(s for s in scene.handle.shapes() if s.id() == "material_0")
    body = dr.opaque(mi.ShapePtr, solid)

    def event(state: tuple[Any, ...]) -> tuple[Any, ...]:
        active, _, at, toward, normal, weight, events, sampler = state
        free = -dr.log(1 - sampler.next_1d(active)) / sigma
        # Off the boundary only to look: what starts there scatters from it on.
        ray = mi.Ray3f(at - offset * normal, toward)
        ray.maxt = dr.select(sigma > 0, free, dr.inf)
        hit = scene.handle.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        met, chance = hit.is_valid(), sampler.next_1d(active)
        cosine = dr.dot(toward, hit.n)
        outer = dr.mulsign(hit.n, cosine)  # away from where the walk comes from
        own = active & met & (hit.shape == body)
        inner = _goes_on(scene, body, hit.p, outer, offset, own)
        leaves = met & ~inner & (chance >= mi.fresnel(dr.abs(cosine), outside)[0])
        at = dr.select(met, hit.p, mi.Point3f(at + ray.maxt * toward))
        normal = dr.select(met, dr.select(inner, -outer, outer), 0)
        sphere = mi.warp.square_to_uniform_sphere(sampler.next_2d(active))
        back = dr.select(inner, toward, toward - 2 * cosine * hit.n)
        toward = dr.select(met, back, sphere)
        events += 1
        escaped = ~met & ~dr.all((at >= low) & (at <= high))
        lost = escaped | (~leaves & (events >= most))
        weight = dr.select(met, weight, weight * alpha)
        # Weights stay at 1 where nothing is absorbed, however long the walk: a chance
        # below 1 would kill the long ones that thick media live by.
        live = dr.fmin(dr.max(weight), 1)
        live = dr.select(met | (events <= ROULETTE_AFTER), 1, live)
        weight = dr.select(lost | (chance >= live), 0, weight / live)
        active &= ~leaves & (dr.max(weight) > 0)
        return active, lost, at, toward, normal, weight, events, sampler

    count, at = dr.width(weight), mi.Point3f(ray.o - offset * inward)
    active, lost = dr.full(mi.Bool, True, count), dr.zeros(mi.Bool, count)
    events, normal = dr.zeros(mi.UInt32, count), -inward
    state = (active, lost, at, ray.d, normal, weight, events, sampler)
    state = dr.while_loop(state, lambda *s: s[0], lambda *s: event(s))
    _, lost, at, _, normal, weight, _, _ = state
    return weight, mi.Point3f(at + offset * normal), normal, lost


def _goes_on(
    scene: LitScene, body: Any, at: Any, outward: Any, offset: Any, active: Any
) -> Any:
    """Whether the medium goes on beyond its boundary, inside another of its solids.

    If so, a ray outward comes to leave them once more than it enters them. Faces that
    coincide count as one of them: solids have to overlap or be apart.
    """
    mi, _ = use_mitsuba()
    import drjit as dr

    def crossing(state: tuple[Any, ...]) -> tuple[Any, ...]:
        active, at, left = state
        ray = mi.Ray3f(at + offset * outward, outward)
        hit = scene.handle.ray_intersect(ray, mi.RayFlags.Minimal, False, active)
        met = active & hit.is_valid()
        sign = dr.select(dr.dot(outward, hit.n) > 0, 1, -1)
        left += dr.select(met & (hit.shape == body), sign, 0)
        return met & (left <= 0), mi.Point3f(hit.p), left

    state = (mi.Bool(active), mi.Point3f(at), dr.zeros(mi.Int32, dr.width(at)))
    _, _, left = dr.while_loop(state, lambda *s: s[0], lambda *s: crossing(s))
    return left > 0


def _irradiance(
    scene: LitScene, at: Any, normal: Any, sampler: Any, active: Any
) -> Any:
    """Direct irradiance at the end of each walk, by few samples of the light."""
    mi, _ = use_mitsuba()
    import drjit as dr

    samples = LIGHT_SAMPLES if isinstance(scene.light, EnvironmentMap) else 1
    receiver = dr.zeros(mi.SurfaceInteraction3f, dr.width(at))
    receiver.p, receiver.n = at, normal
    total, square = mi.Color3f(0), sampler.next_2d()
    for _ in range(samples):
        toward, radiance = scene.handle.sample_emitter_direction(
            receiver, square, False, active
        )
        cosine = dr.dot(toward.d, normal)
        above = active & (toward.pdf > 0) & (cosine > 0)
        met = scene.handle.ray_test(receiver.spawn_ray_to(toward.p), above)
        total += dr.select(above & ~met, radiance * cosine, 0)
        square += mi.Point2f(LATTICE)
        square -= dr.floor(square)
    return total / samples

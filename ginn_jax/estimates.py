"""Estimates of light at points: rays dealt out to lanes, their mean and variance."""

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax.checks import LARGEST_SEED, whole
from ginn_jax.errors import InputError
from ginn_jax.mesh import Mesh
from ginn_jax.reference import OFFSET, columns
from ginn_jax.renderer import use_mitsuba

PATHS_PER_LAUNCH = 2**22


class ColorEstimate(NamedTuple):
    """A Monte Carlo mean and the unbiased variance of that mean, for each point."""

    mean: Float[np.ndarray, "N 3"]
    variance: Float[np.ndarray, "N 3"]


def joined(parts: Iterable[ColorEstimate]) -> ColorEstimate:
    """The estimates of all parts of some points, in their order."""
    nothing = np.zeros((0, 3), np.float32)
    numbers = zip((nothing, nothing), *parts, strict=True)
    return ColorEstimate(*(np.concatenate(number) for number in numbers))


def check_draws(name: str, count: int, seed: int, stratified: bool = False) -> None:
    """Raise `InputError` unless so many random draws a point can be made."""
    if stratified:
        check_stratified(count)
    whole(name, count, 1, PATHS_PER_LAUNCH)
    whole("seed", seed, 0, LARGEST_SEED)


def sampler_of(points: int, paths: int, first: int, seed: int, stratified: bool) -> Any:
    """Random numbers for the paths of so many points, the first of that number: of
    Mitsuba, `stratified` over the paths of a point or independent."""
    mi, _ = use_mitsuba()
    import drjit as dr

    kind = {"type": "multijitter", "sample_count": paths}
    sampler = mi.load_dict(kind if stratified else {"type": "independent"})
    if stratified:
        sampler.set_samples_per_wavefront(paths)
    number = np.random.SeedSequence((seed, first)).generate_state(1)[0]
    sampler.seed(dr.opaque(mi.UInt32, int(number)), points * paths)
    return sampler


def check_stratified(paths: int) -> None:
    """Raise `InputError` unless the sampler has strata for so many."""
    side = math.isqrt(whole("paths", paths, 1, PATHS_PER_LAUNCH))
    if paths % side:
        more = -(-paths // side) * side
        fewer = paths - paths % side
        raise InputError(f"{paths} paths have no strata: give {fewer} or {more}")


def summarize(values: Any, paths: int, stratified: bool = False) -> ColorEstimate:
    """Mean of every `paths` successive values, and the variance of that mean, which is
    known of independent values only."""
    import drjit as dr

    # Or each of the sums below would trace all paths anew.
    dr.eval(values)

    def mean(value: Any) -> np.ndarray:
        total = dr.block_reduce(dr.ReduceOp.Add, value, paths)
        return total.numpy().astype(np.float64) / paths

    middle = np.stack([mean(c) for c in values], axis=1)
    square = np.stack([mean(c * c) for c in values], axis=1)
    spread = np.maximum(square - middle**2, 0.0)
    known = paths > 1 and not stratified
    variance = spread / (paths - 1) if known else np.full_like(spread, np.nan)
    return ColorEstimate(middle.astype(np.float32), variance.astype(np.float32))


def lanes(
    mesh: Mesh,
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    rays: int,
) -> tuple[Any, Any, Any, Any]:
    """Point and ray number of every lane, where it starts, and the normal there."""
    mi, _ = use_mitsuba()
    import drjit as dr

    offset = OFFSET * float(np.abs(mesh.vertices).max())
    start = np.asarray(points, np.float32) + np.float32(offset) * normals
    lane = dr.arange(mi.UInt32, len(points) * rays)
    point = lane // dr.opaque(mi.UInt32, rays)
    ray = lane - point * dr.opaque(mi.UInt32, rays)
    at = dr.gather(mi.Point3f, mi.Point3f(columns(start)), point)
    return point, ray, at, dr.gather(mi.Normal3f, mi.Normal3f(columns(normals)), point)

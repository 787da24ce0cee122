"""Estimates of light at points: rays dealt out to lanes, their mean and variance."""

from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax.checks import LARGEST_SEED, whole
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


def check_draws(name: str, count: int, seed: int) -> None:
    """Raise `InputError` unless so many random draws a point can be made."""
    whole(name, count, 1, PATHS_PER_LAUNCH)
    whole("seed", seed, 0, LARGEST_SEED)


def summarize(values: Any, paths: int) -> ColorEstimate:
    """Mean of every `paths` successive values, and the variance of that mean."""
    import drjit as dr

    # Or each of the sums below would trace all paths anew.
    dr.eval(values)

    def mean(value: Any) -> np.ndarray:
        total = dr.block_reduce(dr.ReduceOp.Add, value, paths)
        return total.numpy().astype(np.float64) / paths

    middle = np.stack([mean(c) for c in values], axis=1)
    square = np.stack([mean(c * c) for c in values], axis=1)
    spread = np.maximum(square - middle**2, 0.0)
    variance = spread / (paths - 1) if paths > 1 else np.full_like(spread, np.nan)
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

"""Random numbers of rays, the same for a point and a ray in any order or part."""

from collections.abc import Callable
from typing import Any

from ginn_jax.renderer import use_mitsuba


def random_pair(x: Any, y: Any, z: Any) -> tuple[Any, Any]:
    """Two random words from three words: `pcg3d` of Jarzynski and Olano, JCGT 2020.

    Hashing (point, ray, seed) makes the rays the same however points are chunked.
    Mitsuba's `sample_tea_32` is no substitute: at its default of 4 rounds the mean of
    a point's rays varied 1.4 to 4 times as much as that of independent ones.
    """
    x, y, z = (v * 1664525 + 1013904223 for v in (x, y, z))
    x += y * z
    y += z * x
    z += x * y
    x, y, z = (v ^ (v >> 16) for v in (x, y, z))
    x += y * z
    y += z * x
    return x, y


def stratified_pair(count: int) -> Callable[[Any, Any, Any], tuple[Any, Any]]:
    """`random_pair` for rays 0 to `count` - 1 of a point that share out the square.

    Hammersley's set: one axis is divided evenly, on the other the digits of the ray's
    number are reversed. Each point shifts the first and flips digits of the second at
    random, so every ray by itself is uniform.
    """
    mi, _ = use_mitsuba()
    import drjit as dr

    step = dr.opaque(mi.UInt32, (2**32 - 1) // count)

    def pair(x: Any, ray: Any, seed: Any) -> tuple[Any, Any]:
        shift, flip = random_pair(x, mi.UInt32(0), seed)
        return ray * step + shift, dr.brev(ray) ^ flip

    return pair

"""Diffuse light on a thick slab of a scattering medium: what leaves it again.

A half space of isotropic scatterers behind a smooth dielectric boundary, solved by
quadrature in float64, and its inverse: from the albedo one sees to the scattering one.
"""

import functools
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from ginn_jax.checks import number, real_array
from ginn_jax.errors import InputError

NODES = 32


def single_scattering_albedo(
    albedo: Float[np.ndarray, "K"], ior: float
) -> Float[np.ndarray, "K"]:
    """Of the medium whose thick slab has `albedo`: the inverse of `slab_albedo`.

    float64, as it is close to 1. Kulla and Conty's fit (2017) behind Saunderson's
    correction is for diffuse light inside: 21 % too dark at albedo .1 and ior 1.5.
    """

    number("index of refraction", ior, 1.0, 2.0)
    if not np.isfinite(real_array("albedo", albedo)).all():
        raise InputError(f"albedo {albedo} is not finite: give it in [0, 1]")
    clipped = np.clip(np.asarray(albedo, np.float64), 0, 1)
    return np.array([_scattering(float(share), ior) for share in clipped])


@functools.lru_cache(maxsize=1 << 12)
def _scattering(share: float, ior: float) -> float:
    """One albedo inverted: 20 ms of root finding, asked for at every launch of rays."""
    if share >= min(slab_albedo(1.0, ior), 1.0):
        return 1.0
    # In the root of absorption the albedo is nearly linear.
    root = brentq(lambda s: slab_albedo(1 - s * s, ior) - share, 0, 1, xtol=1e-9)
    return 1 - float(np.asarray(root)) ** 2


def slab_albedo(alpha: float, ior: float) -> float:
    """Share of the light that entered a half space that leaves it, under diffuse light.

    Exact up to quadrature, about 1e-6: the boundary reflects by Fresnel's equations
    and the medium, of single-scattering albedo `alpha`, by Chandrasekhar's H function
    (Radiative Transfer, 1960), here by its integral over tan(angle).
    """
    x, weight = _gauss(2 * NODES)
    angle = np.pi / 2 * x**2 * (3 - 2 * x)
    weight = weight * 3 * np.pi * x * (1 - x)
    log = np.log1p(-alpha * angle / np.tan(angle))
    cosine, share, mirrored = _inner_directions(ior)
    below = np.cos(angle) ** 2 + np.outer(cosine, np.sin(angle)) ** 2
    h = np.exp(-cosine / np.pi * (log * weight / below).sum(1))
    across = alpha / 4 * np.outer(h, h) / (cosine[:, None] + cosine) * share
    rising = np.eye(len(h)) - across * mirrored
    rising = np.linalg.solve(rising, across @ (1 - mirrored))
    leaving = share * (1 - mirrored)
    return float(leaving @ rising / leaving.sum())


def external_reflectance(ior: float) -> float:
    """Share of diffuse light outside that the boundary reflects."""
    x, weight = _gauss(2 * NODES)
    inside = np.sqrt(1 - (1 - x * x) / ior**2)
    return float(2 * (x * weight) @ _fresnel(x, inside, ior))


@functools.lru_cache
def _inner_directions(ior: float) -> tuple[Any, Any, Any]:
    """Cosines inside, their shares of diffuse light, the reflectance there.

    Nodes crowd above the critical angle, where the reflectance starts as a root does.
    """
    x, weight = _gauss(NODES)
    critical = np.sqrt(1 - 1 / ior**2)
    above = critical + (1 - critical) * x**2
    outside = np.sqrt(np.maximum(1 - (1 - above**2) * ior**2, 0))
    mirrored = np.concatenate([np.ones(NODES), _fresnel(outside, above, ior)])
    cosine = np.concatenate([critical * x**2, above])
    share = 4 * cosine * np.outer([critical, 1 - critical], x * weight).ravel()
    used = share > 0
    return cosine[used], share[used], mirrored[used]


def _fresnel(
    outside: Float[np.ndarray, "n"], inside: Float[np.ndarray, "n"], ior: float
) -> Float[np.ndarray, "n"]:
    """Unpolarised reflectance of a dielectric, by the cosines on both sides."""
    across = (outside - ior * inside) / (outside + ior * inside)
    along = (ior * outside - inside) / (ior * outside + inside)
    return (across**2 + along**2) / 2


def _gauss(count: int) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Gauss-Legendre nodes and weights on [0, 1]."""
    x, weight = np.polynomial.legendre.leggauss(count)
    return (x + 1) / 2, weight / 2

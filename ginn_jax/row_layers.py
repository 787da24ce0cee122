"""Layers of f_3D that take a point at a time, by JAX, between the sums over neighbours.

Rows go up to the next bucket: few shapes, so few compilations.
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ginn_jax.architecture import Conv, Network
from ginn_jax.example import points_asked
from ginn_jax.network import Code, Latent, McConv, enter, join
from ginn_jax.receptive_field import Oriented

# Features side by side, as skips leave them, of every channel.
Parts = tuple[Code, ...]


@partial(jax.jit, static_argnums=0)
def enter_rows(
    network: Network,
    normal: Float[Array, "N 3"],
    material: Float[Array, "C N A"] | None,
    light: Float[Array, "C N L"] | None,
) -> Code:
    """What the points show f_3D of themselves, in every channel."""
    points = Oriented(None, normal, None)

    def channel(material: Array | None, light: Array | None) -> Code:
        return Code(*enter(network, *points_asked(points, material, light)))

    if light is None:
        return jax.tree.map(lambda a: a[None], channel(material, light))
    return jax.vmap(channel)(material, light)


@partial(jax.jit, static_argnums=(0, 1))
def rows_before(network: Network, conv: Conv, weights: Any, parts: Parts) -> Code:
    """What a convolution is given: the layers before it."""
    layer = McConv(network, conv, train=False)

    def channel(parts: Parts) -> Any:
        code = join(*parts)
        return layer.apply({"params": weights}, code, _all(code), None, 0)

    return jax.vmap(channel)(parts)


@partial(jax.jit, static_argnums=0)
def latent_rows(
    network: Network, weights: Any, parts: Parts, light: Float[Array, "C N L"] | None
) -> Code:
    """The codes."""
    layer = Latent(network, train=False)

    def channel(parts: Parts, light: Array | None) -> Any:
        code = join(*parts)
        return layer.apply({"params": weights}, code, light, _all(code))

    return jax.vmap(channel)(parts, light)


def _all(code: Code) -> Any:
    return jnp.ones(np.shape(code.free)[0], bool)

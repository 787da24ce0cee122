"""The two learned steps: f_3D from points to codes, f_2D from codes to queries.

The paper's sections "3D Step" and "2D Step". Written for one cloud and one channel of
light; which layers there are is `architecture`'s table. 1x1 layers and norms are flax
linen's, convolutions are `mcconv`'s.
"""

from functools import partial
from typing import Any, NamedTuple

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ginn_jax.architecture import Conv, Network
from ginn_jax.geometry import Geometry
from ginn_jax.kernels import EXACT, init_kernel
from ginn_jax.mcconv import apply_stored, mc_conv, mc_conv_mixing, weighted_sum
from ginn_jax.receptive_field import Field

SLOPE, EPSILON = 0.2, 1e-3
# What a point weighs in a splat that faces another way: little, but never nothing.
LEAST_LIKENESS = 1e-3
# The collection of kernel values that are at hand already, see `relight`.
STORED = "stored"
Variables = dict[str, Any]
dense = partial(nn.Dense, precision=EXACT)


class Norm(nn.Module):
    """Normalisation over the rows that count, then leaky ReLU."""

    kind: str
    train: bool

    @nn.compact
    def __call__(self, x: Float[Array, "N C"], mask: Bool[Array, "N"]) -> Array:
        if self.kind == "batch":
            norm = nn.BatchNorm(not self.train, momentum=0.95, epsilon=EPSILON)
            x = norm(x, mask=jnp.broadcast_to(mask[:, None], x.shape))
        elif self.kind == "layer":
            x = nn.LayerNorm(epsilon=EPSILON)(x)
        return nn.leaky_relu(x, SLOPE)


class Code(NamedTuple):
    """What a point carries: `free` features, and `light` ones, linear in the light.

    Networks that are neither linear nor have beams have no `light` inside f_3D: it came
    in among the attributes. `local` ones hand the point's own on to f_2D.
    """

    free: Float[Any, "N K"]
    light: Float[Any, "N V"] | None


def enter(
    network: Network, attributes: Array, light: Array | None
) -> tuple[Array, Array | None]:
    """Attributes and light as the network takes them."""
    if light is None or network.linear:
        return attributes, light
    both = jnp.concatenate([attributes, light], axis=1)
    return both, light if network.beams else None


def join(*codes: Code) -> Code:
    """Features side by side."""
    free = jnp.concatenate([c.free for c in codes], axis=1)
    beams = [c.light for c in codes if c.light is not None]
    return Code(free, jnp.concatenate(beams, axis=1) if beams else None)


class Gate(nn.Module):
    """A linear map of the light whose outputs the free features scale."""

    width: int

    @nn.compact
    def __call__(
        self, free: Float[Array, "N K"], light: Float[Array, "N V"]
    ) -> Float[Array, "N W"]:
        ones = nn.initializers.ones_init()
        gate = dense(self.width, bias_init=ones, name="gate")(free)
        return gate * dense(self.width, use_bias=False, name="light")(light)


class McConv(nn.Module):
    """One row of the table: what comes before, and the Monte Carlo convolution."""

    network: Network
    conv: Conv
    train: bool

    @nn.compact
    def __call__(
        self, x: Code, mask: Bool[Array, "N"], field: Field | None, receivers: int
    ) -> Code:
        """Without a field: what is convolved, by others."""
        conv, network = self.conv, self.network
        free, light = x
        if conv.before in ("norm", "dense"):
            free = Norm(network.norm, self.train)(free, mask)
        if conv.before in ("dense", "lift"):
            free = dense(conv.channels)(free)
            free = Norm(network.norm, self.train)(free, mask)
            if light is not None:
                light = Gate(network.beams or conv.channels)(free, light)
        if field is None:
            return Code(free, light)
        both = free if light is None else jnp.concatenate([free, light], axis=1)
        kernels = conv.channels * free.shape[1] if conv.mixes else both.shape[1]
        sizes = kernels, network.hidden, network.group or kernels
        inputs = field.inputs.shape[0]
        kernel = self.param("kernel", lambda key: init_kernel(inputs, *sizes, key=key))
        if conv.mixes:
            given = kernel, free, field, receivers, conv.channels
            return Code(mc_conv_mixing(*given), None)
        width = free.shape[1]
        if self.has_variable(STORED, "kernel"):
            stored = self.get_variable(STORED, "kernel")
            found = apply_stored(stored, both, field, receivers)
        else:
            found = mc_conv(kernel, both, field, receivers)
        return Code(found[:, :width], None if light is None else found[:, width:])


def latent_layers(
    network: Network,
    train: bool,
    x: Code,
    light: Float[Array, "N L"] | None,
    mask: Bool[Array, "N"],
) -> Code:
    """The code of a point, from its features after the last convolution of f_3D.

    To be called by a module, whose layers these are.
    """
    free = x.free
    if network.encoder:
        free = Norm(network.norm, train)(free, mask)
    free = dense(network.latent, name="latent")(free)
    free = Norm(network.norm, train)(free, mask)
    beams = []
    if x.light is not None:
        width = network.beams or network.latent
        beams = [Gate(width, name="latent_light")(free, x.light)]
    if network.local and light is not None:
        beams = [light, *beams]
    return Code(free, jnp.concatenate(beams, axis=1) if beams else None)


class Latent(nn.Module):
    """The last layers of `Encoder` alone."""

    network: Network
    train: bool

    @nn.compact
    def __call__(
        self, x: Code, light: Float[Array, "N L"] | None, mask: Bool[Array, "N"]
    ) -> Code:
        return latent_layers(self.network, self.train, x, light, mask)


class Encoder(nn.Module):
    """f_3D: the encoder-decoder, from attributes and light to a code per point."""

    network: Network
    train: bool

    @nn.compact
    def __call__(
        self,
        attributes: Float[Array, "N C"],
        light: Float[Array, "N L"] | None,
        geometry: Geometry,
    ) -> Code:
        network, levels = self.network, geometry.levels
        done: dict[str, Code] = {}
        x = Code(*enter(network, attributes, light))
        for conv in network.encoder:
            layer = McConv(network, conv, self.train, name=conv.name)
            field, target = geometry.fields[conv.name], levels[conv.target]
            x = layer(x, levels[conv.source].mask, field, target.mask.shape[0])
            if conv.skip is not None:
                x = join(done[conv.skip], x)
            done[conv.name] = x
        return latent_layers(network, self.train, x, light, levels[0].mask)


def splat(values: Float[Array, "N"], field: Field, receivers: int) -> Float[Array, "M"]:
    """Mean of the values near each receiver, the near and alike oriented first."""
    near = (1 - jnp.sum(field.inputs[:3] ** 2, axis=0)) ** 2
    if field.inputs.shape[0] > 3:
        near *= jnp.maximum(field.inputs[5], 0.0) ** 4 + LEAST_LIKENESS
    both = jnp.stack([values, jnp.ones_like(values)], axis=1)
    share = near * field.weight
    total, weight = weighted_sum(share[None], both, field, receivers).T
    return jnp.where(weight > 0, total / jnp.where(weight > 0, weight, 1.0), 0.0)


class Shader(nn.Module):
    """f_2D: one convolution from codes to queries, then two 1x1 layers.

    A network that splats has its 1x1 layers at the points instead.
    """

    network: Network
    train: bool

    @nn.compact
    def __call__(
        self,
        code: Code,
        attributes: Float[Array, "M A"],
        light: Float[Array, "M L"] | None,
        mask: Bool[Array, "M"],
        field: Field,
        senders: Bool[Array, "N"],
    ) -> Float[Array, "M"]:
        network = self.network
        if network.splat:
            free = dense(network.head)(code.free)
            free = Norm(network.norm, self.train)(free, senders)
            values = dense(1)(free)[:, 0]
            if code.light is not None:
                dimmed = Gate(network.head, name="out_light")(free, code.light)
                values += jnp.sum(dimmed, axis=1)
            return splat(values, field, mask.shape[0])
        layer = McConv(network, network.query, self.train, name=network.query.name)
        x = layer(code, senders, field, attributes.shape[0])
        seen, _ = enter(network, attributes, light)
        free = Norm(network.norm, self.train)(x.free, mask)
        free = dense(network.head)(jnp.concatenate([free, seen], axis=1))
        free = Norm(network.norm, self.train)(free, mask)
        values = jnp.zeros(mask.shape)
        if not network.linear:
            values = dense(1)(free)[:, 0]
        if x.light is None:
            return values
        beams = [x.light] if light is None else [x.light, light]
        dimmed = Gate(network.head, name="out_light")(free, jnp.concatenate(beams, 1))
        return values + jnp.sum(dimmed, axis=1)

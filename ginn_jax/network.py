"""The two learned steps: f_3D from points to codes, f_2D from codes to queries.

The paper's sections "3D Step" and "2D Step". Written for one cloud and one channel of
light; which layers there are is `architecture`'s table. 1x1 layers and norms are flax
linen's, convolutions are `mcconv`'s.
"""

from typing import Any

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ginn_jax.architecture import Conv, Network
from ginn_jax.geometry import Geometry
from ginn_jax.mcconv import init_kernel, mc_conv, mc_conv_mixing
from ginn_jax.receptive_field import Field

SLOPE = 0.2
Variables = dict[str, Any]


class Norm(nn.Module):
    """Normalisation over the rows that count, then leaky ReLU."""

    kind: str
    train: bool

    @nn.compact
    def __call__(self, x: Float[Array, "N C"], mask: Bool[Array, "N"]) -> Array:
        if self.kind == "batch":
            norm = nn.BatchNorm(not self.train, momentum=0.95, epsilon=1e-3)
            x = norm(x, mask=jnp.broadcast_to(mask[:, None], x.shape))
        elif self.kind == "layer":
            x = nn.LayerNorm(epsilon=1e-3)(x)
        return nn.leaky_relu(x, SLOPE)


class McConv(nn.Module):
    """One row of the table: what comes before, and the Monte Carlo convolution."""

    config: Network
    conv: Conv
    train: bool

    @nn.compact
    def __call__(
        self,
        x: Float[Array, "N C"],
        mask: Bool[Array, "N"],
        field: Field,
        receivers: int,
    ) -> Float[Array, "M K"]:
        conv, config = self.conv, self.config
        if conv.before in ("norm", "dense"):
            x = Norm(config.norm, self.train)(x, mask)
        if conv.before in ("dense", "lift"):
            x = nn.Dense(conv.channels)(x)
            x = Norm(config.norm, self.train)(x, mask)
        kernels = conv.channels * (x.shape[1] if conv.mixes else 1)
        kernel = self.param(
            "kernel",
            lambda key: init_kernel(
                field.inputs.shape[0],
                kernels,
                config.hidden,
                config.group or kernels,
                key=key,
            ),
        )
        if conv.mixes:
            return mc_conv_mixing(kernel, x, field, receivers, conv.channels)
        return mc_conv(kernel, x, field, receivers)


class Encoder(nn.Module):
    """f_3D: the encoder-decoder, from attributes per point to a code per point."""

    config: Network
    train: bool

    @nn.compact
    def __call__(
        self, attributes: Float[Array, "N C"], geometry: Geometry
    ) -> Float[Array, "N K"]:
        config, levels = self.config, geometry.levels
        done: dict[str, Array] = {}
        x = attributes
        for conv in config.encoder:
            layer = McConv(config, conv, self.train, name=conv.name)
            field, target = geometry.fields[conv.name], levels[conv.target]
            x = layer(x, levels[conv.source].mask, field, target.mask.shape[0])
            if conv.skip is not None:
                x = jnp.concatenate([done[conv.skip], x], axis=1)
            done[conv.name] = x
        x = Norm(config.norm, self.train)(x, levels[0].mask)
        x = nn.Dense(config.latent, name="latent")(x)
        return Norm(config.norm, self.train)(x, levels[0].mask)


class Shader(nn.Module):
    """f_2D: one convolution from codes to queries, then two 1x1 layers."""

    config: Network
    train: bool

    @nn.compact
    def __call__(
        self,
        codes: Float[Array, "N K"],
        attributes: Float[Array, "M A"],
        mask: Bool[Array, "M"],
        field: Field,
    ) -> Float[Array, "M"]:
        config = self.config
        layer = McConv(config, config.query, self.train, name=config.query.name)
        x = layer(codes, jnp.ones(codes.shape[0], bool), field, attributes.shape[0])
        x = Norm(config.norm, self.train)(x, mask)
        x = nn.Dense(config.head)(jnp.concatenate([x, attributes], axis=1))
        x = Norm(config.norm, self.train)(x, mask)
        return nn.Dense(1)(x)[:, 0]

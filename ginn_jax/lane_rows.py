"""Layers of f_3D that take a point at a time: `network`'s 1x1 layers, norms and gates.

In lanes where they are small. Every weight stands in a program, which takes half a
millisecond a weight to compile: large layers, which few points have, are JAX's.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ginn_jax.architecture import Conv, Network
from ginn_jax.lane_layers import Constants, dense, from_constants, gate, norm
from ginn_jax.lanes import Lane, Lanes, read_record, write_record
from ginn_jax.network import Code, Latent, McConv, join

# Weights of the layers before a convolution that are in lanes.
MOST_WEIGHTS = 1 << 12


class Width(NamedTuple):
    """How many free features, and how many light ones."""

    free: int
    light: int


def as_code(width: Width, record: Float[np.ndarray, "C N _"]) -> Code:
    """Features of a record by kind."""
    light = record[..., width.free : sum(width)]
    return Code(record[..., : width.free], light if width.light else None)


def feature_widths(network: Network) -> list[Width]:
    """Of what each convolution is given and leaves, and of the codes."""
    free = 3 + network.materials + (0 if network.linear else network.lights)
    light = network.lights if network.linear or network.beams else 0
    found, done = [], dict[str, Width]()
    for conv in network.encoder:
        if conv.before in ("dense", "lift"):
            free, light = conv.channels, light and (network.beams or conv.channels)
        found.append(Width(free, light))
        skipped = done[conv.skip] if conv.skip else Width(0, 0)
        free, light = done[conv.name] = Width(
            free + skipped.free, light + skipped.light
        )
    beams = light and (network.beams or network.latent)
    own = network.lights if network.local else 0
    return [*found, Width(network.latent, own + beams)]


def params_before(weights: Any, conv: Conv | None) -> Any:
    """Weights of the layers before a convolution; without one, of the last layers."""
    if conv is not None:
        return {k: v for k, v in weights[conv.name].items() if k != "kernel"}
    names = ("Norm_0", "Norm_1", "latent", "latent_light")
    return {name: weights[name] for name in names if name in weights}


def in_program(params: Any) -> bool:
    """Whether such layers run in lanes."""
    return sum(np.size(a) for a in jax.tree.leaves(params)) <= MOST_WEIGHTS


def write_layers(
    dr: Any,
    network: Network,
    conv: Conv | None,
    weights: Constants,
    widths: tuple[Width, ...],
    parts: list[Any],
    light: Any,
    to: Lane,
    left: Any,
) -> Any:
    """The program: what all `parts` have in a record, put through the layers, is
    written to another; `light`: the points' own."""
    rows = dr.width(to)
    lane = dr.arange(dr.llvm.UInt32, rows)
    read = [read_record(dr, part, rows, lane) for part in parts]
    free = [x for w, row in zip(widths, read, strict=True) for x in row[: w.free]]
    beams = [
        x for w, row in zip(widths, read, strict=True) for x in row[w.free : sum(w)]
    ]
    own = [] if light is None else read_record(dr, light, rows, lane)
    given = dr, network, from_constants(weights), Code(free, beams or None)
    if conv is None:
        found = _latent(*given, own[: network.lights])
    else:
        found = _before(*given, conv)
    write_record(dr, left, [*found.free, *(found.light or [])], to)
    return left


def _before(dr: Any, network: Network, params: Any, x: Code, conv: Conv) -> Code:
    """What `network.McConv` does before it convolves."""
    free, beams = x
    norms = iter([params.get("Norm_0"), params.get("Norm_1")])
    if conv.before in ("norm", "dense"):
        free = norm(dr, network, next(norms), free)
    if conv.before in ("dense", "lift"):
        free = norm(dr, network, next(norms), dense(dr, params["Dense_0"], free))
        if beams is not None:
            beams = gate(dr, params["Gate_0"], free, beams)
    return Code(free, beams)


def _latent(dr: Any, network: Network, params: Any, x: Code, light: Lanes) -> Code:
    """What `network.latent_layers` does."""
    free, beams = x.free, []
    norms = iter([params.get("Norm_0"), params.get("Norm_1")])
    if network.encoder:
        free = norm(dr, network, next(norms), free)
    free = norm(dr, network, next(norms), dense(dr, params["latent"], free))
    if x.light is not None:
        beams = gate(dr, params["latent_light"], free, x.light)
    if network.local:
        beams = light + beams
    return Code(free, beams or None)


@partial(jax.jit, static_argnums=(0, 1))
def layers_by_jax(
    network: Network,
    conv: Conv | None,
    params: Any,
    parts: tuple[Code, ...],
    light: Float[Array, "C N L"] | None,
) -> Code:
    """The same of rows in every channel."""

    def channel(parts: tuple[Code, ...], light: Array | None) -> Any:
        code = join(*parts)
        everyone = jnp.ones(code.free.shape[0], bool)
        if conv is None:
            layer = Latent(network, train=False)
            return layer.apply({"params": params}, code, light, everyone)
        layer = McConv(network, conv, train=False)
        return layer.apply({"params": params}, code, everyone, None, 0)

    return jax.vmap(channel)(parts, light)

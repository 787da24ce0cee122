"""f_2D in blocks, as a GPU runs it: a call to time, and the memory of a block."""

from collections.abc import Callable
from typing import Any

import numpy as np

from ginn_jax import block_shading, blocks, image
from ginn_jax.architecture import Network
from ginn_jax.limits import Limits, only
from ginn_jax.network import Variables
from ginn_jax.process import on_cpu
from ginn_jax.receptive_field import Oriented
from ginn_jax.reference import GBuffer
from ginn_jax.shading import Encoded
from ginn_jax.upsample import Surface


def blocks_call(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    gbuffer: GBuffer,
) -> tuple[Callable[[], Any], Limits]:
    """f_2D in blocks, as a GPU runs it, to pixels and their values; limits that fit."""
    surface = Surface(gbuffer.position, gbuffer.normal, gbuffer.mask)
    encoded = block_shading.searchable(network, encoded)

    def shade(limits: Limits) -> tuple[np.ndarray, np.ndarray, Limits]:
        given = network, encoded.center, surface, (None, None)
        rows, pixels, coherent = image.pixels_in_order(*given)
        ends: Any = network, limits, variables, encoded, *pixels
        return rows, *block_shading.shade_blocks(*ends, coherent=coherent)

    fitting = shade(limits)[2]
    return lambda: shade(fitting)[:2], fitting


def block_memory(
    network: Network, limits: Limits, variables: Variables, encoded: Encoded
) -> int:
    """Scratch memory of one block of f_2D, the same for every image, in bytes."""
    rows = blocks.largest_block(lit=False)
    encoded = block_shading.searchable(network, encoded)
    zeros = np.zeros((rows, 3), np.float32)
    queries = Oriented(zeros, zeros, np.ones(rows, bool))
    flat = only(limits, network.query.name)
    turn = blocks.turn_shapes(blocks.Turn(queries))
    shared = blocks.everywhere((variables, encoded))
    lowered = block_shading.shade_turn.lower(network, flat, on_cpu(), *shared, turn)
    memory = lowered.compile().memory_analysis()
    return int(memory.temp_size_in_bytes) if memory else 0

"""f_2D by JAX, in blocks of queries over all devices.

For a GPU, for networks that do not run in lanes, and where there is no libLLVM. Where a
capacity is too small the need is measured and all blocks are shaded again.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float

from ginn_jax.architecture import Network
from ginn_jax.blocks import (
    Turn,
    block_size,
    everywhere,
    for_each_block,
    in_rows,
    largest_block,
    make_turns,
    pad_channels,
    pad_points,
)
from ginn_jax.facets import Around
from ginn_jax.levels import grid_of
from ginn_jax.limits import (
    SLACK,
    Demands,
    Limits,
    fitted,
    measure_limits,
    only,
    say_raised,
    with_room,
)
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.network import Code, Variables
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Oriented
from ginn_jax.searches import uniform_limits, warn_of_gaps
from ginn_jax.shading import Encoded, Searched, query_demands, shade
from ginn_jax.voxels import VoxelGrid


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=ALONE)
def shade_turn(
    network: Network,
    limits: Limits,
    coherent: bool,
    variables: Variables,
    encoded: Encoded,
    turn: Turn,
) -> tuple[Float[Array, "D *C R"], Demands]:
    """`shade` for a block of queries on every device."""

    def shade_block(shared: Any, block: Any) -> tuple[Array, Demands]:
        return shade(network, limits, *shared, *block, coherent=coherent)

    return for_each_block(shade_block, (variables, encoded), turn)


@partial(jax.jit, static_argnums=(0, 1, 2), compiler_options=ALONE)
def _query_demands(
    network: Network,
    limits: Limits,
    coherent: bool,
    searched: Searched,
    turn: Oriented,
) -> Demands:
    """`query_demands` of a block of queries on every device."""
    measure = partial(query_demands, network, limits, coherent=coherent)
    return for_each_block(measure, searched, turn)


def query_limits(
    network: Network,
    searched: Searched,
    turns: Sequence[Oriented],
    coherent: bool = False,
) -> Limits:
    """Limits that hold what f_2D of each block needs, measured with ample ones."""
    ample = uniform_limits(network, 16 * turns[0].mask.shape[1])
    searched = everywhere(searched)

    def probe(limits: Limits, number: int) -> Demands:
        given = network, limits, coherent, searched, turns[number]
        return jax.device_get(_query_demands(*given))

    return measure_limits(only(ample, network.query.name), probe, len(turns), SLACK)


def searchable(network: Network, encoded: Encoded) -> Encoded:
    """With grids for what JAX searches, where f_3D ran in lanes and made none."""
    if encoded.grid is not None:
        return encoded
    rows, around = bucket(len(encoded.points.mask)), encoded.around
    points = pad_points(None, *encoded.points[:2], rows)
    if around is not None:
        most = bucket(len(around.points.mask))
        samples = pad_points(None, *around.points[:2], most)
        light = pad_channels(around.light, most)
        around = Around(samples, _grid(network, -1, samples), light)
    free, beams = encoded.code
    if encoded.scale is None:
        code = Code(pad_rows(np.asarray(free), rows)[0], None)
    else:
        code = Code(pad_channels(free, rows), pad_channels(beams, rows))
    area = pad_rows(np.asarray(encoded.area), rows)[0]
    made = points, _grid(network, 0, points), area, code, encoded.scale
    found = Encoded(*jax.device_put(made), around=jax.device_put(around))
    return found._replace(center=encoded.center, kept=encoded.kept)


@partial(jax.jit, static_argnums=(0, 1))
def _grid(network: Network, level: int, points: Oriented) -> VoxelGrid:
    return grid_of(network, {}, level, points)


def shade_turns(
    network: Network,
    variables: Variables,
    encoded: Encoded,
    turns: Sequence[Turn],
    coherent: bool,
    limits: Limits,
) -> tuple[list[Array], list[Demands]]:
    """Values of the blocks of every turn, and their demands; may not be done yet."""
    encoded = searchable(network, encoded)
    needed = {"shader": variables["shader"]}, encoded._replace(center=None, kept=None)
    given = network, only(limits, network.query.name), coherent, *everywhere(needed)
    made = [shade_turn(*given, turn) for turn in turns]
    return [values for values, _ in made], [demands for _, demands in made]


def shade_blocks(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    material: Float[np.ndarray, "C M A"] | None = None,
    light: Float[np.ndarray, "C M L"] | None = None,
    coherent: bool = False,
) -> tuple[Float[np.ndarray, "M *C"], Limits]:
    """`shade_points` by JAX, in blocks over all devices, with limits that sufficed.

    Points that come `coherent`, neighbours together, need not be sorted.
    """
    encoded, lit = searchable(network, encoded), encoded.scale is not None
    turns = make_turns(lit, encoded.center, position, normal, material, light)
    attempt = partial(shade_turns, network, variables, encoded, turns, coherent)
    queries = [turn.queries for turn in turns]
    measure = partial(query_limits, network, encoded.searched(), queries, coherent)
    parts, sufficed, demands = with_room(limits, attempt, measure)
    size = block_size(len(position), lit)
    if 2 * size > largest_block(lit):  # the next may be larger
        sufficed = fitted(sufficed, demands)
    say_raised(limits, sufficed)
    name = f"{network.query.name}.edges"
    pairs = sum(int(np.sum(demand[name])) for demand in demands)
    warn_of_gaps(network.query, pairs, len(position))
    channels = () if encoded.scale is None else encoded.scale.shape
    if not parts:
        return np.zeros((0, *channels), np.float32), sufficed
    return in_rows(parts)[: len(position)], sufficed

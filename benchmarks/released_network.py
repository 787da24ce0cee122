"""The networks that the authors released in 2019, run by this package.

Their table of layers is `presets.RELEASED`, their weights are read by
`released_weights`; here are f_3D and f_2D with what they take: of a point its normal,
irradiance, albedo and, where light scatters, extinction and index of refraction; of a
query of indirect light its normal, of scattered light all. One network serves all
colours, and unlike ours it does not find the unit of light by itself: `Seen` gives it.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from ginn_jax.block_shading import query_limits
from ginn_jax.blocks import (
    Turn,
    block_size,
    channels_in_turns,
    each_its_own,
    everywhere,
    for_each_block,
    in_rows,
    in_turns,
    pad_channels,
    pad_points,
)
from ginn_jax.dataset import center_of
from ginn_jax.geometry import build_geometry, build_query_field
from ginn_jax.limits import (
    SLACK,
    Demands,
    Limits,
    largest,
    measure_limits,
    only,
    with_room,
    without,
)
from ginn_jax.lit_clouds import LitCloud
from ginn_jax.neighbors import bucket
from ginn_jax.network import Code, Encoder, Shader, Variables
from ginn_jax.presets import RELEASED
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Oriented, in_coherent_order
from ginn_jax.searches import uniform_limits
from ginn_jax.shading import Encoded, cloud_demands


class Seen(NamedTuple):
    """What a network is shown of light and matter, in units of its own.

    exposure    the mean irradiance of every colour
    density     of an extinction of 1 per longest side
    """

    exposure: float
    density: float = 1.0


class Deep(NamedTuple):
    """Codes of a cloud for all that the network is shown, a channel for every colour of
    each, and what an irradiance of 1 is there."""

    encoded: Encoded
    units: Float[np.ndarray, "S 3"]


class Released(NamedTuple):
    """A network of theirs, all that it is shown, and limits to begin with."""

    effect: str
    variables: Variables
    seens: tuple[Seen, ...]
    limits: Limits
    key: Any


def released_at(
    network: Released, given: LitCloud, asked: LitCloud
) -> tuple[Float[np.ndarray, "S N 3"], Released]:
    """What it says of points, given others, for all that it is shown; with the limits
    that it took."""
    effect, variables, seens, limits, key = network
    deep, limits = encode_released(limits, variables, given, seens, key=key)
    values, limits = shade_released(effect, limits, variables, deep, asked, seens)
    values = np.maximum(values, 0.0).astype(np.float32)
    return np.moveaxis(values, 1, 0), network._replace(limits=limits)


def first_limits(clouds: Sequence[LitCloud], *, key: Any) -> Limits:
    """Limits that hold what f_3D of these clouds needs; those of f_2D are found when it
    is asked."""
    points = [placed(cloud) for cloud in clouds]
    ample = uniform_limits(RELEASED, 16 * max(len(p.mask) for p in points))

    def probe(limits: Limits, number: int) -> Demands:
        deep = without(limits, RELEASED.query.name)
        return jax.device_get(_demands(deep, points[number], key))

    found = measure_limits(ample, probe, len(points), SLACK)
    return largest(uniform_limits(RELEASED, 64), found)


@partial(jax.jit, static_argnums=0)
def _demands(limits: Limits, cloud: Oriented, key: Key[Array, ""]) -> Demands:
    return cloud_demands(RELEASED, limits, cloud, None, key)


def placed(cloud: LitCloud) -> Oriented:
    """A cloud counted from its center, and padded."""
    rows = bucket(len(cloud.position))
    return pad_points(center_of(cloud.position), cloud.position, cloud.normal, rows)


def encode_released(
    limits: Limits,
    variables: Variables,
    cloud: LitCloud,
    seens: Sequence[Seen],
    *,
    key: Any,
) -> tuple[Deep, Limits]:
    """f_3D of a cloud, and the limits that sufficed."""
    mean = cloud.irradiance.mean(axis=0, dtype=np.float64)
    units = np.stack([mean / seen.exposure for seen in seens])
    points, center = placed(cloud), center_of(cloud.position)
    numbers = pad_channels(attributes(cloud, units, seens), len(points.mask))

    def attempt(limits: Limits) -> tuple[Encoded, list[Demands]]:
        deep = without(limits, RELEASED.query.name)
        made, demands = _encode(deep, variables, points, numbers, key)
        return made, [demands]

    measure = partial(first_limits, [cloud], key=key)
    encoded, limits, _ = with_room(limits, attempt, measure)
    return Deep(everywhere(encoded)._replace(center=center), units), limits


def shade_released(
    effect: str,
    limits: Limits,
    variables: Variables,
    deep: Deep,
    asked: LitCloud,
    seens: Sequence[Seen],
) -> tuple[Float[np.ndarray, "N S 3"], Limits]:
    """Indirect irradiance or radiant exitance at points, and limits that sufficed."""
    encoded, size = deep.encoded, block_size(len(asked.position), lit=True)
    turns = in_turns(encoded.center, asked.position, asked.normal, size)
    numbers = attributes(asked, deep.units, seens)
    numbers = numbers if effect == "sss" else numbers[..., :0]
    shares = channels_in_turns(numbers, size, len(turns))
    shared = {"shader": variables["shader"]}, encoded._replace(center=None, kept=None)

    def attempt(limits: Limits) -> tuple[list[Array], list[Demands]]:
        flat = only(limits, RELEASED.query.name)
        made = [
            _shade(flat, *everywhere(shared), each_its_own(Turn(turn, share)))
            for turn, share in zip(turns, shares, strict=True)
        ]
        return [values for values, _ in made], [demands for _, demands in made]

    def measure() -> Limits:
        """With room for twice as much: else most scenes would compile anew."""
        found = query_limits(RELEASED, encoded.searched(), turns)
        return Limits(tuple((name, 2 * size) for name, size in found.sizes))

    parts, limits, _ = with_room(limits, attempt, measure)
    values = in_rows(parts)[: len(asked.position)]
    return values.reshape(-1, *deep.units.shape) * deep.units, limits


def attributes(
    cloud: LitCloud, units: Float[np.ndarray, "S 3"], seens: Sequence[Seen]
) -> Float[np.ndarray, "C N A"]:
    """What they see of every point beside its normal, for each colour of each."""
    albedo = cloud.albedo[cloud.material].T
    made = []
    for unit, seen in zip(units, seens, strict=True):
        light = cloud.irradiance.T / np.where(unit > 0, unit, 1.0)[:, None]
        columns = [light, albedo]
        if cloud.medium.size:
            extinction, ior = cloud.medium
            medium = seen.density * extinction, ior
            columns += [np.full_like(light, number) for number in medium]
        made.append(np.stack(columns, axis=2))
    return np.concatenate(made).astype(np.float32)


@partial(jax.jit, static_argnums=0)
def _encode(
    limits: Limits,
    variables: Variables,
    cloud: Oriented,
    numbers: Float[Array, "C N A"],
    key: Key[Array, ""],
) -> tuple[Encoded, Demands]:
    """f_3D of every colour."""
    cloud, order = in_coherent_order(cloud)
    geometry, demands = build_geometry(RELEASED, limits, cloud, order, key=key)
    finest, rows = geometry.levels[0], order[geometry.finest]

    def channel(numbers: Float[Array, "M A"]) -> Any:
        seen = jnp.concatenate([finest.normal, numbers], axis=1)
        seen = jnp.where(finest.mask[:, None], seen, 0.0)
        encoder = Encoder(RELEASED, train=False)
        return encoder.apply(variables["encoder"], seen, None, geometry)

    codes: Code = jax.vmap(channel)(numbers[:, rows])
    made = Encoded(finest, geometry.grid, None, codes, None, kept=geometry.kept)
    return made, demands


@partial(jax.jit, static_argnums=0, compiler_options=ALONE)
def _shade(
    limits: Limits, variables: Variables, encoded: Encoded, turn: Turn
) -> tuple[Float[Array, "D C R"], Demands]:
    """f_2D of every colour, a block on every device."""

    def block(shared: Any, turn: Turn) -> tuple[Array, Demands]:
        variables, encoded = shared
        queries, order = in_coherent_order(turn.queries)
        ends = encoded.points, encoded.grid, None, queries
        field, demands = build_query_field(RELEASED, limits, *ends)
        senders = jnp.ones(encoded.points.mask.shape, bool)
        numbers: Any = turn.material

        def channel(code: Code, numbers: Float[Array, "R A"]) -> Array:
            seen = jnp.concatenate([queries.normal, numbers[order]], axis=1)
            given = code, seen, None, queries.mask, field, senders
            values: Any = Shader(RELEASED, train=False).apply(
                variables["shader"], *given
            )
            return jnp.zeros_like(values).at[order].set(values)

        return jax.vmap(channel)(encoded.code, numbers), demands

    return for_each_block(block, (variables, encoded), turn)

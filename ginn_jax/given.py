"""What f_3D and f_2D are given, checked at the door: is it of that network?

Weights and codes of another one may have shapes that fit, and would then give numbers
that look like values.
"""

from functools import cache
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ginn_jax.architecture import Network
from ginn_jax.checks import channels_alike, numbers_of, unit_rows, within_reach
from ginn_jax.errors import InputError
from ginn_jax.example import blank_example
from ginn_jax.lane_rows import Width, feature_widths
from ginn_jax.network import Variables
from ginn_jax.objective import init_variables
from ginn_jax.shading import Encoded


def check_kept(kept: Any, shape: tuple[int, int]) -> None:
    """Raise `InputError` unless these are samples kept of a cloud of that shape."""
    given = np.zeros(shape, bool) if kept is None else np.asarray(kept)
    if given.shape != shape or given.dtype != bool:
        raise InputError(
            f"kept_before is {given.dtype} {given.shape}, not bool {shape}: give what "
            "the same network kept of as many points"
        )


def check_queries(
    network: Network,
    variables: Variables,
    encoded: Encoded,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    material: Float[np.ndarray, "C M A"] | None,
    light: Float[np.ndarray, "C M L"] | None,
) -> None:
    """Raise what `shade_points` does."""
    unit_rows(position, normal)
    within_reach("points", position)
    if network.asks == "all":
        numbers_of("material", material, network.materials, len(position))
        numbers_of("light", light, network.lights, len(position), least=0.0)
        channels_alike(encoded.scale, material, light)
    check_weights(network, variables)
    check_codes(network, encoded)


def check_codes(network: Network, encoded: Encoded) -> None:
    """Raise `InputError` for codes of another network, as far as their widths tell."""
    free, beams = encoded.code
    found = Width(free.shape[-1], 0 if beams is None else beams.shape[-1])
    same = found == feature_widths(network)[-1]
    lit = (encoded.scale is None) == (network.lights == 0)
    if not (same and lit and (encoded.around is None) == (network.smooth == 0)):
        raise InputError(
            "the codes are of another network: give what encode_cloud makes by the "
            "network that shades"
        )


def check_weights(network: Network, variables: Variables) -> None:
    """Raise `InputError` unless all are the network's, by their names and shapes."""
    found, tree = jax.tree.flatten(variables)
    shapes, own = weight_shapes(network)
    if tree != own or shapes != [getattr(a, "shape", None) for a in found]:
        raise InputError(
            "the weights are not this network's: give those that were loaded or "
            "trained with it"
        )


@cache
def weight_shapes(network: Network) -> tuple[list[tuple[int, ...]], Any]:
    """The shape of every weight of a network, and the tree that they are in."""

    def init() -> Variables:
        example = blank_example(network)
        return init_variables(network, example, key=jax.random.key(0))

    found, tree = jax.tree.flatten(jax.eval_shape(init))
    return [a.shape for a in found], tree

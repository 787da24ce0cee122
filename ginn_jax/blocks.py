"""Points on the host made ready for compiled functions: padded, in blocks.

Few shapes, so few compilations: clouds are padded to the next bucket, queries come in
blocks, of which all devices have about as many to do.
"""

import jax
import numpy as np
from jaxtyping import Float

from ginn_jax.dataset import relative_to
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.receptive_field import Oriented

BLOCK = 1 << 15


def largest_block(lit: bool) -> int:
    """Queries of a block: half as many where three colours share a core's cache."""
    return BLOCK // 2 if lit else BLOCK


def block_size(points: int, lit: bool) -> int:
    """Queries of a block such that all devices have about as many to do."""
    most = largest_block(lit)
    turns = -(-points // (most * jax.device_count()))
    return min(most, bucket(-(-points // max(turns * jax.device_count(), 1))))


def pad_points(
    center: Float[np.ndarray, "3"] | None,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    rows: int,
) -> Oriented:
    """Points counted from `center`, and padding up to `rows`."""
    place, mask = pad_rows(relative_to(center, position), rows)
    return Oriented(place, pad_rows(np.asarray(normal, np.float32), rows)[0], mask)


def pad_channels(
    numbers: Float[np.ndarray, "C N A"] | None, rows: int
) -> Float[np.ndarray, "C R A"] | None:
    """Zeros for rows up to `rows`."""
    if numbers is None:
        return None
    padding = ((0, 0), (0, rows - numbers.shape[1]), (0, 0))
    return np.pad(np.asarray(numbers, np.float32), padding)


def in_blocks(
    center: Float[np.ndarray, "3"] | None,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    size: int,
) -> list[Oriented]:
    """Points counted from `center`, so many at a time; the last block is padded."""
    rows = -(-len(position) // size) * size
    points = pad_points(center, position, normal, rows)
    return [Oriented(*(a[i : i + size] for a in points)) for i in range(0, rows, size)]

"""Points on the host made ready for compiled functions: padded, in blocks.

Few shapes, so few compilations: clouds are padded to the next bucket, queries come in
turns of a block for every device, and one program serves all devices.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh as DeviceMesh
from jax.sharding import NamedSharding, PartitionSpec
from jaxtyping import Float

from ginn_jax.dataset import relative_to
from ginn_jax.neighbors import bucket, pad_rows
from ginn_jax.process import on_cpu
from ginn_jax.receptive_field import Oriented

BLOCK = 1 << 15
# A GPU has as many lanes as queries; what a block needs has to fit its memory.
GPU_BLOCKS = 8

_EACH = "device"
Shared = TypeVar("Shared")


class Turn(NamedTuple):
    """A block of queries for every device, with what the network asks of them."""

    queries: Oriented
    material: Float[Any, "D C R A"] | None = None
    light: Float[Any, "D C R L"] | None = None


def largest_block(lit: bool) -> int:
    """Queries of a block: half as many where three colours share a core's cache."""
    return BLOCK * (1 if on_cpu() else GPU_BLOCKS) // (2 if lit else 1)


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


def in_turns(
    center: Float[np.ndarray, "3"] | None,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    size: int,
) -> list[Oriented]:
    """Points counted from `center`, in turns of a block of `size` for every device.

    Arrays of a turn are [D size ...] for D devices; the last turn is padded.
    """
    each = jax.device_count() * size
    turns = -(-len(position) // each)
    points = pad_points(center, position, normal, turns * each)
    shape = turns, jax.device_count(), size
    blocks = Oriented(*(a.reshape(*shape, *a.shape[1:]) for a in points))
    return [Oriented(*(a[turn] for a in blocks)) for turn in range(turns)]


def channels_in_turns(
    numbers: Float[np.ndarray, "C M A"] | None, size: int, turns: int
) -> Sequence[Float[np.ndarray, "D C size A"] | None]:
    """What comes with the points of as many turns; the last is padded."""
    shape = turns, jax.device_count(), size
    if numbers is None:
        return [None] * turns
    padded = np.asarray(pad_channels(numbers, int(np.prod(shape))))
    split = padded.reshape(len(numbers), *shape, numbers.shape[2])
    return list(np.moveaxis(split, 0, 2))


def make_turns(
    lit: bool,
    center: Float[np.ndarray, "3"] | None,
    position: Float[np.ndarray, "M 3"],
    normal: Float[np.ndarray, "M 3"],
    material: Float[np.ndarray, "C M A"] | None = None,
    light: Float[np.ndarray, "C M L"] | None = None,
) -> list[Turn]:
    """Points in turns of a block for every device, with what is asked of them."""
    size = block_size(len(position), lit)
    queries = in_turns(center, position, normal, size)
    numbers = (channels_in_turns(a, size, len(queries)) for a in (material, light))
    return list(map(Turn, queries, *numbers))


def in_rows(turns: Sequence[Any]) -> Float[np.ndarray, "M *C"]:
    """Values [D *C size] of all turns as those of points, one after the other."""
    rows = [np.moveaxis(np.asarray(turn), -1, 1) for turn in turns]
    return np.concatenate([turn.reshape(-1, *turn.shape[2:]) for turn in rows])


def turn_shapes(block: Any) -> Any:
    """Shapes and types of a turn of such blocks."""
    count = jax.device_count()
    return jax.tree.map(
        lambda a: jax.ShapeDtypeStruct((count, *a.shape), a.dtype), block
    )


def everywhere(arrays: Shared) -> Shared:
    """Copies on every device: what all blocks are given."""
    return jax.device_put(arrays, NamedSharding(_device_mesh(), PartitionSpec()))


def each_its_own(turn: Shared) -> Shared:
    """The blocks of a turn, each on its device."""
    return jax.device_put(turn, NamedSharding(_device_mesh(), PartitionSpec(_EACH)))


def for_each_block(function: Callable[[Any, Any], Any], shared: Any, turn: Any) -> Any:
    """`function(shared, block)` for the blocks of a turn, one on every device.

    What is made of them has their first axis. One program, compiled once: jit alone
    compiles for every device by itself.
    """

    def own(shared: Any, turn: Any) -> Any:
        made = function(shared, jax.tree.map(lambda a: a.squeeze(0), turn))
        return jax.tree.map(lambda a: a[None], made)

    each = PartitionSpec(_EACH)
    specs = {"in_specs": (PartitionSpec(), each), "out_specs": each}
    mesh = _device_mesh()
    return jax.shard_map(own, mesh=mesh, **specs, check_vma=False)(shared, turn)


def _device_mesh() -> DeviceMesh:
    return DeviceMesh(np.array(jax.devices()), (_EACH,))

"""f_2D as one would first write it: the yardstick of `benchmarks.f2d`.

Each pixel looks up the nine columns of the grid around it, lists the candidates of its
runs, tests them one by one, compacts the list to edges, gathers both ends of each edge,
evaluates the kernel row by row and sums by `segment_sum`, all pixels at once.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ginn_jax.architecture import Network
from ginn_jax.mcconv import Kernel
from ginn_jax.network import SLOPE, Variables
from ginn_jax.receptive_field import Oriented
from ginn_jax.voxels import VoxelGrid, cell_of, compact, expand_ranges, narrow_runs


def nine_runs(
    grid: VoxelGrid, query: Float[Array, "M 3"], radius: Float[Array, ""]
) -> tuple[Int[Array, "M*9"], Int[Array, "M*9"]]:
    """Start and length of the runs of rows in the columns around each query."""
    step = jnp.arange(3, dtype=jnp.int32) - 1
    x, y = (cell_of(grid, query[:, a], a)[:, None] + step for a in (0, 1))
    inside = ((x >= 0) & (x < grid.shape[0]))[:, :, None]
    inside &= ((y >= 0) & (y < grid.shape[1]))[:, None]
    column = jnp.where(inside, x[:, :, None] * grid.shape[1] + y[:, None], 0)
    first = grid.column_start[column]
    last = jnp.where(inside, grid.column_start[column + 1], first)
    reach = 1.00001 * radius
    low, high = (cell_of(grid, query[:, 2] + d, 2) for d in (-reach, reach))
    low, high = (jnp.broadcast_to(a[:, None, None], first.shape) for a in (low, high))
    start, stop = narrow_runs(grid.layer, first, last, low, high + 1)
    return start.reshape(-1), (stop - start).reshape(-1)


def shade_plainly(
    network: Network,
    candidates: int,
    edges: int,
    variables: Variables,
    encoded: Any,
    queries: Oriented,
) -> tuple[Float[Array, "M"], Int[Array, ""], Int[Array, ""]]:
    """f_2D of all queries at once, and the candidates and edges that took."""
    radius = jnp.float32(network.query.radius)
    grid, points = encoded.grid, encoded.points
    start, length = nine_runs(grid, queries.position, radius)
    slots, tested = expand_ranges(start, length, candidates)
    owner = slots.owner // 9
    squared = jnp.sum((queries.position[owner] - grid.position[slots.row]) ** 2, -1)
    kept, real, found = compact(slots.valid & (squared < radius**2), edges)
    sender = jnp.where(real, grid.index[slots.row[kept]], 0)
    receiver = jnp.where(real, owner[kept], 0)
    offset = (queries.position[receiver] - points.position[sender]) / radius
    ends = queries.normal[receiver], points.normal[sender]
    pairs = (ends[0], offset), (ends[1], offset), ends, (offset, offset)
    products = [jnp.sum(a * b, axis=-1, keepdims=True) for a, b in pairs]
    inputs = jnp.concatenate([offset, *products], axis=-1)
    weight = jnp.where(real, encoded.area[sender] / (jnp.pi * radius**2), 0.0)
    kernel = Kernel(*variables["shader"]["params"]["query"]["kernel"])
    values = perceptron(kernel, inputs) * encoded.code.free[sender] * weight[:, None]
    x = jax.ops.segment_sum(values, receiver, queries.mask.shape[0])
    return head(variables["shader"]["params"], x, queries.normal), tested, found


def perceptron(kernel: Kernel, inputs: Float[Array, "E D"]) -> Float[Array, "E K"]:
    """The kernel of one block, row by row."""
    w1, b1, w2, b2, w3, b3 = (a[0] for a in kernel)
    hidden = jax.nn.relu(inputs @ w1 + b1)
    return jax.nn.relu(hidden @ w2 + b2) @ w3 + b3


def head(
    params: Variables, x: Float[Array, "M K"], normal: Float[Array, "M 3"]
) -> Float[Array, "M"]:
    """The two 1x1 layers with their layer norms."""
    x = _norm(params["Norm_0"]["LayerNorm_0"], x)
    x = _dense(params["Dense_0"], jnp.concatenate([x, normal], axis=1))
    return _dense(params["Dense_1"], _norm(params["Norm_1"]["LayerNorm_0"], x))[:, 0]


def _norm(params: Variables, x: Float[Array, "M K"]) -> Float[Array, "M K"]:
    mean, variance = jnp.mean(x, -1, keepdims=True), jnp.var(x, -1, keepdims=True)
    x = (x - mean) / jnp.sqrt(variance + 1e-3)
    x = x * params["scale"] + params["bias"]
    return jnp.where(x > 0, x, SLOPE * x)


def _dense(params: Variables, x: Float[Array, "M K"]) -> Float[Array, "M L"]:
    return x @ params["kernel"] + params["bias"]

"""f_2D as one would first write it: the yardstick of `benchmarks.f2d`.

Nothing in it but the layers' shapes is the library's: points are sorted by the key of
their cell, each pixel finds the nine runs of cells around it by binary search, the runs
are expanded to one list with `jnp.repeat`, tested one by one, compacted to edges with
`jnp.nonzero`, both ends of each edge gathered, the kernel evaluated row by row, and the
results summed by `segment_sum`, all pixels at once.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ginn_jax.architecture import Network
from ginn_jax.kernels import Kernel
from ginn_jax.network import SLOPE, Variables
from ginn_jax.receptive_field import Oriented

# Cells an axis at most: three of them make a key of 30 bits.
CELLS = 1 << 10


def nine_runs(
    points: Oriented, query: Float[Array, "M 3"], radius: Float[Array, ""]
) -> tuple[Int[Array, "N"], Int[Array, "M*9"], Int[Array, "M*9"]]:
    """Points in order of their cells; start and length of the runs at each query."""
    far = jnp.where(points.mask[:, None], points.position, jnp.inf)
    low = jnp.min(far, axis=0)
    cell = jnp.floor((far - low) / (1.0001 * radius)).astype(jnp.int32)
    cell = jnp.clip(cell + 1, 0, CELLS - 1)
    key = (cell[:, 0] * CELLS + cell[:, 1]) * CELLS + cell[:, 2]
    key = jnp.where(points.mask, key, jnp.int32(2**31 - 1))
    order = jnp.argsort(key)
    own = jnp.floor((query - low) / (1.0001 * radius)).astype(jnp.int32) + 1
    step = jnp.arange(-1, 2)
    x, y = (jnp.clip(own[:, a, None] + step, 0, CELLS - 1) for a in (0, 1))
    column = (x[:, :, None] * CELLS + y[:, None]).reshape(-1, 9) * CELLS
    z = jnp.clip(own[:, 2, None], 1, CELLS - 2)
    start = jnp.searchsorted(key[order], column + z - 1)
    stop = jnp.searchsorted(key[order], column + z + 1, side="right")
    return order, start.reshape(-1), (stop - start).reshape(-1)


def shade_plainly(
    network: Network,
    candidates: int,
    edges: int,
    variables: Variables,
    encoded: Any,
    queries: Oriented,
) -> tuple[Float[Array, "M"], Int[Array, ""], Int[Array, ""]]:
    """f_2D of all queries at once, and the candidates and edges that took."""
    radius, points = jnp.float32(network.query.radius), encoded.points
    order, start, length = nine_runs(points, queries.position, radius)
    end = jnp.cumsum(length)
    run = jnp.repeat(jnp.arange(length.size), length, total_repeat_length=candidates)
    place = jnp.arange(candidates)
    sender = order[start[run] + place - (end[run] - length[run])]
    owner = run // 9
    squared = jnp.sum((queries.position[owner] - points.position[sender]) ** 2, -1)
    near = (place < end[-1]) & (squared < radius**2)
    found = jnp.sum(near)
    kept = jnp.nonzero(near, size=edges)[0]
    real = jnp.arange(edges) < found
    sender, receiver = sender[kept], owner[kept]
    offset = (queries.position[receiver] - points.position[sender]) / radius
    ends = queries.normal[receiver], points.normal[sender]
    pairs = (ends[0], offset), (ends[1], offset), ends, (offset, offset)
    products = [jnp.sum(a * b, axis=-1, keepdims=True) for a, b in pairs]
    inputs = jnp.concatenate([offset, *products], axis=-1)
    weight = jnp.where(real, encoded.area[sender] / (jnp.pi * radius**2), 0.0)
    kernel = Kernel(*variables["shader"]["params"]["query"]["kernel"])
    values = perceptron(kernel, inputs) * encoded.code.free[sender] * weight[:, None]
    x = jax.ops.segment_sum(values, receiver, queries.mask.shape[0])
    return head(variables["shader"]["params"], x, queries.normal), end[-1], found


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

"""The layer that is timed, and the same in PyTorch: gather, products, `index_add_`."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float, Int

from ginn_jax.kernels import Kernel, init_kernel
from ginn_jax.neighbors import find_neighbors
from ginn_jax.process import available_cores

INPUTS = 7

Calls = dict[str, Callable[[], Any]]


class Edges(NamedTuple):
    """`receptive_field.Field` of every cloud, padded to the longest."""

    sender: Int[np.ndarray, "B E"]
    receiver: Int[np.ndarray, "B E"]
    inputs: Float[np.ndarray, "B D E"]
    weight: Float[np.ndarray, "B E"]
    count: Int[np.ndarray, "B"]


class Layer(NamedTuple):
    """A kernel; features, edges and a cotangent of every cloud of a batch."""

    kernel: Kernel
    features: Float[np.ndarray, "B N C"]
    edges: Edges
    cotangent: Float[np.ndarray, "B N C"]


def make_layer(
    clouds: Sequence[Float[np.ndarray, "N 3"]],
    radius: float,
    channels: int,
    hidden: int,
    seed: int,
) -> Layer:
    """A layer on these clouds, with random weights, features and normals."""
    rng, key = np.random.default_rng(seed), jax.random.key(seed)
    kernel = init_kernel(INPUTS, channels, hidden, channels, key=key)
    pairs = [find_neighbors(points, points, radius) for points in clouds]
    longest = max(len(sender) for _, sender in pairs)
    parts = [
        _edges(rng, kernel, points, found, radius, longest)
        for points, found in zip(clouds, pairs, strict=True)
    ]
    edges = Edges(*map(np.stack, zip(*parts, strict=True)))
    shape = len(clouds), len(clouds[0]), channels
    features, cotangent = (rng.normal(size=shape).astype(np.float32) for _ in range(2))
    return Layer(kernel, features, edges, cotangent)


def _edges(
    rng: np.random.Generator,
    kernel: Kernel,
    points: Float[np.ndarray, "N 3"],
    found: tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]],
    radius: float,
    rows: int,
) -> tuple[np.ndarray, ...]:
    """Edges of a cloud with itself, padded, with random normals and weights."""
    receiver, sender = found
    inputs = rng.normal(size=(INPUTS, len(sender))).astype(np.float32)
    inputs[:3] = ((points[receiver] - points[sender]) / radius).T
    weight = rng.uniform(0.5, 1.5, len(sender)).astype(np.float32)
    weight[at_kink(kernel, inputs)] = 0
    gap = (0, rows - len(sender))
    return (
        np.pad(sender, gap),
        np.pad(receiver, gap, constant_values=len(points)),
        np.pad(inputs, ((0, 0), gap)),
        np.pad(weight, gap),
        np.array(len(sender), np.int32),
    )


def at_kink(kernel: Kernel, inputs: np.ndarray) -> np.ndarray:
    """The few edges so near a kink of a ReLU that rounding chooses the slope there."""
    w1, b1, w2, b2, *_ = (np.asarray(a[0], np.float64) for a in kernel)
    first = inputs.T @ w1 + b1
    second = np.maximum(first, 0) @ w2 + b2
    return np.any(np.abs(np.concatenate([first, second], axis=1)) < 1e-5, axis=1)


def as_one_cloud(layer: Layer) -> Calls:
    """The batch as one cloud on all cores; raises ImportError without PyTorch."""
    import torch  # pyright: ignore

    features = layer.features.reshape(-1, layer.features.shape[2])
    points = layer.features.shape[1]
    parts = [_of_cloud(layer, i, i * points) for i in range(len(layer.features))]
    edges = tuple(map(np.concatenate, zip(*parts, strict=True)))
    cotangent = layer.cotangent.reshape(features.shape)
    apply = _in_torch(layer.kernel, edges, features, cotangent)
    shape = layer.features.shape

    def gradient() -> list[Any]:
        torch.set_num_threads(available_cores())
        *weights, found = apply["gradient"]()
        return [*weights, found.reshape(shape)]

    def forward() -> Any:
        torch.set_num_threads(available_cores())
        return apply["forward"]().reshape(shape)

    return {"forward": forward, "gradient": gradient}


def on_threads(layer: Layer) -> Calls:
    """Every cloud on a thread of its own; raises ImportError without PyTorch."""
    import torch  # pyright: ignore

    pool = ThreadPoolExecutor(available_cores())
    clouds = [
        _in_torch(layer.kernel, _of_cloud(layer, i), *ends)
        for i, ends in enumerate(zip(layer.features, layer.cotangent, strict=True))
    ]

    def of_each(part: str) -> list[Any]:
        torch.set_num_threads(1)
        return list(pool.map(lambda cloud: cloud[part](), clouds))

    def gradient() -> list[Any]:
        parts = zip(*of_each("gradient"), strict=True)
        *weights, features = (torch.stack(part) for part in parts)
        return [*(w.sum(0) for w in weights), features]

    return {"forward": lambda: torch.stack(of_each("forward")), "gradient": gradient}


def _of_cloud(layer: Layer, number: int, first: int = 0) -> tuple[np.ndarray, ...]:
    """Sender, receiver, inputs [E D] and weight of a cloud's real edges.

    Its points are rows from `first` on.
    """
    sender, receiver, inputs, weight, count = (a[number] for a in layer.edges)
    rows = sender[:count] + first, receiver[:count] + first
    return *rows, np.ascontiguousarray(inputs[:, :count].T), weight[:count]


def _in_torch(
    kernel: Kernel,
    edges: tuple[np.ndarray, ...],
    features: Float[np.ndarray, "N C"],
    cotangent: Float[np.ndarray, "N C"],
) -> Calls:
    """Forward and gradient of one cloud; `edges` as `_of_cloud` has them."""
    import torch  # pyright: ignore

    sender, receiver, inputs, weight = edges
    there = partial(torch.tensor, device="cuda" if torch.cuda.is_available() else "cpu")
    weights = [there(np.array(a[0])) for a in kernel]
    x, given, seen = map(there, (features, cotangent, inputs))
    rows, ends = (there(a.astype(np.int64)) for a in (sender, receiver))
    share = there(weight)[:, None]

    def apply(weights: Any, x: Any) -> Any:
        w1, b1, w2, b2, w3, b3 = weights
        hidden = torch.relu(torch.addmm(b1, seen, w1))
        values = torch.addmm(b3, torch.relu(torch.addmm(b2, hidden, w2)), w3)
        return torch.zeros_like(given).index_add_(0, ends, values * x[rows] * share)

    def forward() -> Any:
        with torch.no_grad():
            return arrived(apply(weights, x))

    def gradient() -> Any:
        leaves = [a.clone().requires_grad_() for a in (*weights, x)]
        objective = (apply(leaves[:-1], leaves[-1]) * given).sum()
        return arrived(torch.autograd.grad(objective, leaves))

    def arrived(result: Any) -> Any:
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        return result

    return {"forward": forward, "gradient": gradient}


PEERS = {"PyTorch": as_one_cloud, "PyTorch, a thread a cloud": on_threads}

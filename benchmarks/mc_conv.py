"""One Monte Carlo convolution, forward and gradient: ours against plain PyTorch.

    python -m benchmarks.mc_conv

The same layer on the same edges: a kernel perceptron of offsets and normals per edge,
times the features of the sender, summed at the receiver; gradients of all weights and
of the features. PyTorch's is written with gather, matrix products and `index_add_`.
Results are compared before anything is timed. Open3D's ContinuousConv is another layer
(a grid of weights instead of a perceptron): its time stands beside, not its result.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.neighbors import surface, uniform
from benchmarks.timing import circumstances, describe, measure
from ginn_jax import report
from ginn_jax.commandline import require, require_positive, require_some, start
from ginn_jax.kernels import Kernel, init_kernel
from ginn_jax.mcconv import mc_conv
from ginn_jax.neighbors import find_neighbors
from ginn_jax.process import available_cores
from ginn_jax.receptive_field import Field

INPUTS = 7
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Options:
    """Time a depth-wise Monte Carlo convolution, forward and with its gradient."""

    out: Path = Path("runs/mc_conv")
    """Folder for metrics.json and report.md."""
    points: int = 10_000
    """Points of the cloud, senders and receivers alike."""
    radii: tuple[float, ...] = (0.025, 0.05)
    """Radii of the receptive field."""
    channels: int = 24
    """Feature channels."""
    hidden: int = 16
    """Width of the kernel perceptron."""
    repeats: int = 11
    """Timed calls of each variant."""
    seed: int = 0
    """Seed of points, features and weights."""
    quick: bool = False
    """Few points: to try things, not for numbers."""


QUICK = {"points": 1000, "radii": (0.05,), "repeats": 2}


def make_layer(
    options: Options, radius: float, points: np.ndarray
) -> tuple[Kernel, jax.Array, Field, jax.Array]:
    """Kernel, features, edges of a cloud with itself, and a cotangent."""
    rng = np.random.default_rng(options.seed)
    receiver, sender = find_neighbors(points, points, radius)
    inputs = rng.normal(size=(INPUTS, len(sender))).astype(np.float32)
    inputs[:3] = ((points[receiver] - points[sender]) / radius).T
    key = jax.random.key(options.seed)
    width = options.channels
    kernel = init_kernel(INPUTS, width, options.hidden, width, key=key)
    weight = rng.uniform(0.5, 1.5, len(sender)).astype(np.float32)
    weight[at_kink(kernel, inputs)] = 0
    edges = (sender, receiver, inputs, weight, np.int32(len(sender)))
    field = Field(*map(jnp.asarray, edges))
    features, cotangent = (
        jnp.asarray(rng.normal(size=(len(points), width)), jnp.float32)
        for _ in range(2)
    )
    return kernel, features, field, cotangent


def at_kink(kernel: Kernel, inputs: np.ndarray) -> np.ndarray:
    """The few edges so near a kink of a ReLU that rounding chooses the slope there."""
    w1, b1, w2, b2, *_ = (np.asarray(a[0], np.float64) for a in kernel)
    first = inputs.T @ w1 + b1
    second = np.maximum(first, 0) @ w2 + b2
    return np.any(np.abs(np.concatenate([first, second], axis=1)) < 1e-5, axis=1)


def ours(layer: Any) -> dict[str, Callable[[], Any]]:
    """Forward and gradient on all devices' threads, as one call."""
    *arguments, cotangent = layer
    count = cotangent.shape[0]

    def objective(kernel: Kernel, features: Any, field: Field) -> Any:
        return jnp.sum(mc_conv(kernel, features, field, count) * cotangent)

    forward = jax.jit(lambda k, x, f: mc_conv(k, x, f, count))
    gradient = jax.jit(jax.grad(objective, argnums=(0, 1)))
    return {
        "forward": partial(forward, *arguments),
        "gradient": partial(gradient, *arguments),
    }


def in_torch(layer: Any) -> dict[str, Callable[[], Any]]:
    """The plain PyTorch version on all cores; raises ImportError without PyTorch."""
    import torch  # pyright: ignore

    torch.set_num_threads(available_cores())
    kernel, features, field, cotangent = jax.tree.map(np.asarray, layer)
    weights = [torch.tensor(a[0]) for a in kernel]
    x, given = torch.tensor(features), torch.tensor(cotangent)
    inputs = torch.tensor(np.ascontiguousarray(field.inputs.T))
    sender, receiver = (torch.tensor(a.astype(np.int64)) for a in field[:2])
    weight = torch.tensor(field.weight)[:, None]

    def apply(weights: Any, x: Any) -> Any:
        w1, b1, w2, b2, w3, b3 = weights
        hidden = torch.relu(torch.addmm(b1, inputs, w1))
        values = torch.addmm(b3, torch.relu(torch.addmm(b2, hidden, w2)), w3)
        total = torch.zeros_like(given)
        return total.index_add_(0, receiver, values * x[sender] * weight)

    def forward() -> Any:
        with torch.no_grad():
            return apply(weights, x)

    def gradient() -> Any:
        leaves = [a.clone().requires_grad_() for a in (*weights, x)]
        return torch.autograd.grad(
            (apply(leaves[:-1], leaves[-1]) * given).sum(), leaves
        )

    return {"forward": forward, "gradient": gradient}


def in_open3d(layer: Any, points: np.ndarray, radius: float) -> Callable[[], Any]:
    """Open3D's ContinuousConv of the same width, forward, its search included."""
    import open3d.ml.torch as ml  # pyright: ignore
    import torch  # pyright: ignore

    width = layer[1].shape[1]
    conv = ml.layers.ContinuousConv(width, width, kernel_size=[4, 4, 4])
    place = torch.tensor(points, dtype=torch.float32)
    x = torch.tensor(np.asarray(layer[1]))

    def forward() -> Any:
        with torch.no_grad():
            return conv(x, place, place, extents=2 * radius)

    return forward


def check(
    mine: dict[str, Callable[[], Any]], theirs: dict[str, Callable[[], Any]]
) -> float:
    """Largest difference relative to the largest value; AssertionError if too large."""
    worst = 0.0
    kernel, features = mine["gradient"]()
    pairs = [(mine["forward"](), theirs["forward"]())]
    pairs += zip([*(a[0] for a in kernel), features], theirs["gradient"](), strict=True)
    for a, b in pairs:
        a, b = np.asarray(a), np.asarray(b)
        worst = max(worst, float(np.abs(a - b).max() / np.abs(b).max()))
    if worst > TOLERANCE:
        raise AssertionError(f"PyTorch's results differ by {worst}")
    return worst


def compare(options: Options, cloud: str, radius: float) -> dict[str, Any]:
    """Agreement and times on one cloud."""
    rng = np.random.default_rng(options.seed)
    points = {"uniform": uniform, "surface": surface}[cloud](rng, options.points)
    layer = make_layer(options, radius, points)
    mine = ours(layer)
    calls = {f"ours, {name}": call for name, call in mine.items()}
    case: dict[str, Any] = {"cloud": cloud, "radius": radius, "missing": []}
    case |= {"edges": int(layer[2].count), "difference": float("nan")}
    try:
        theirs = in_torch(layer)
        case["difference"] = check(mine, theirs)
        calls |= {f"PyTorch, {name}": call for name, call in theirs.items()}
    except ImportError:
        case["missing"].append("PyTorch")
    try:
        calls["Open3D ContinuousConv, forward"] = in_open3d(layer, points, radius)
    except Exception as error:  # its builds refuse many versions of PyTorch
        case["missing"].append(f"Open3D ContinuousConv ({type(error).__name__})")
    return case | {"timings": measure(calls, options.repeats)}


def main(options: Options) -> dict[str, Any]:
    """Compare on two clouds; returns what metrics.json holds."""
    require(options, {"points": 100, "channels": 1, "hidden": 1, "repeats": 1})
    require_positive(options, "radii")
    require_some(options, "radii")
    begin = time.perf_counter()
    cases = [
        compare(options, c, r) for r in options.radii for c in ("uniform", "surface")
    ]
    text = write_report(options, cases)
    for case in cases:
        case["timings"] = {n: t.record() for n, t in case["timings"].items()}
    metrics = {"cases": cases} | circumstances(options, begin)
    report.write_results(options.out, metrics, text)
    print(text)
    return metrics


def write_report(options: Options, cases: list[dict[str, Any]]) -> str:
    """report.md: times and ratios, a row for each cloud and radius."""
    names = list(cases[0]["timings"])
    heads = ["cloud", "radius", "edges", *names]
    peer = "PyTorch, gradient" in names
    heads += ["PyTorch / ours, forward", "PyTorch / ours, gradient"] if peer else []
    rows = []
    for case in cases:
        t = case["timings"]
        row = [
            case["cloud"],
            case["radius"],
            case["edges"],
            *(str(t[n]) for n in names),
        ]
        if peer:
            row += [
                t[f"PyTorch, {part}"].median / t[f"ours, {part}"].median
                for part in ("forward", "gradient")
            ]
        rows.append(row)
    missing = sorted({name for case in cases for name in case["missing"]})
    return f"""# One Monte Carlo convolution

{options.points} points, {options.channels} channels, depth-wise, kernel perceptron
{INPUTS}-{options.hidden}-{options.hidden}-{options.channels}; "gradient" is forward and
gradient of all weights and features; edges given; median of {options.repeats} calls ±
half the interquartile range. Largest relative difference between ours and PyTorch's:
{max(case["difference"] for case in cases):.1e}.
Missing peers: {"; ".join(missing) or "none"}.

{describe()}

{report.markdown_table(heads, rows)}"""


if __name__ == "__main__":
    start(Options, main, QUICK)

"""One Monte Carlo convolution, forward and gradient: ours against plain PyTorch.

    python -m benchmarks.mc_conv

The same layer on the same edges: a kernel perceptron of offsets and normals per edge,
times the features of the sender, summed at the receiver; gradients of all weights and
of the features. The batch has a cloud for every core, as in training. Ours gives each
core its cloud. PyTorch's takes the batch as one cloud on all cores, or each cloud on a
thread of its own, whichever is faster. Results are compared before anything is timed.
Points come in coherent order, as f_3D has them, and once more in random order, in which
the rows that edges gather lie far apart in memory.
Open3D's ContinuousConv is another layer (a grid of weights instead of a perceptron):
its time stands beside, not its result, and is of one cloud.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from benchmarks.mc_conv_peers import INPUTS, PEERS, Calls, Layer, make_layer
from benchmarks.neighbors import surface, uniform
from benchmarks.timing import describe, measure, write_cases
from ginn_jax import report
from ginn_jax.blocks import each_its_own, everywhere, for_each_block
from ginn_jax.commandline import require, require_positive, require_some, start
from ginn_jax.kernels import Kernel
from ginn_jax.mcconv import mc_conv
from ginn_jax.process import ALONE
from ginn_jax.receptive_field import Field, Oriented, in_coherent_order

TOLERANCE = 1e-4
ORDERS = "coherent", "random"


@dataclass(frozen=True)
class Options:
    """Time a depth-wise Monte Carlo convolution, forward and with its gradient."""

    out: Path = Path("runs/mc_conv")
    """Folder for metrics.json and report.md."""
    points: int = 10_000
    """Points of each cloud, senders and receivers alike."""
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


def ours(layer: Layer) -> Calls:
    """Forward and gradient, every device its cloud."""
    count = layer.features.shape[1]

    def forward(kernel: Kernel, cloud: Any) -> Any:
        features, field, _ = cloud
        return mc_conv(kernel, features, field, count)

    def gradient(kernel: Kernel, cloud: Any) -> Any:
        def objective(kernel: Kernel, features: Any) -> Any:
            made = forward(kernel, (features, *cloud[1:]))
            return jnp.sum(made * cloud[2])

        of_kernel, of_features = jax.grad(objective, argnums=(0, 1))(kernel, cloud[0])
        return ravel_pytree(of_kernel)[0], of_features

    @partial(jax.jit, compiler_options=ALONE)
    def all_gradients(kernel: Kernel, batch: Any) -> Any:
        kernels, features = for_each_block(gradient, kernel, batch)
        return ravel_pytree(kernel)[1](kernels.sum(axis=0)), features

    @partial(jax.jit, compiler_options=ALONE)
    def all_forward(kernel: Kernel, batch: Any) -> Any:
        return for_each_block(forward, kernel, batch)

    batch = layer.features, Field(*map(jnp.asarray, layer.edges)), layer.cotangent
    given = everywhere(layer.kernel), each_its_own(batch)
    return {
        "forward": partial(all_forward, *given),
        "gradient": partial(all_gradients, *given),
    }


def in_open3d(layer: Layer, points: np.ndarray, radius: float) -> Callable[[], Any]:
    """Open3D's ContinuousConv of the same width, forward, its search included."""
    import open3d.ml.torch as ml  # pyright: ignore
    import torch  # pyright: ignore

    width = layer.features.shape[2]
    conv = ml.layers.ContinuousConv(width, width, kernel_size=[4, 4, 4])
    place = torch.tensor(points, dtype=torch.float32)
    x = torch.tensor(layer.features[0])

    def forward() -> Any:
        with torch.no_grad():
            return conv(x, place, place, extents=2 * radius)

    return forward


def on_host(result: Any) -> np.ndarray:
    """What a peer made, which may be on a GPU."""
    return np.asarray(result.cpu() if hasattr(result, "cpu") else result)


def check(mine: Calls, theirs: Calls) -> float:
    """Largest difference relative to the largest value; AssertionError if too large."""
    worst = 0.0
    kernel, features = mine["gradient"]()
    pairs = [(mine["forward"](), theirs["forward"]())]
    pairs += zip([*(a[0] for a in kernel), features], theirs["gradient"](), strict=True)
    for a, b in pairs:
        a, b = np.asarray(a), on_host(b)
        worst = float(np.maximum(worst, np.abs(a - b).max() / np.abs(b).max()))
    if not worst <= TOLERANCE:
        raise AssertionError(f"PyTorch's results differ by {worst}")
    return worst


def neighbors_together(points: np.ndarray) -> np.ndarray:
    """The points in the order in which f_3D has them."""
    place, everyone = jnp.asarray(points), jnp.ones(len(points), bool)
    return np.asarray(in_coherent_order(Oriented(place, place, everyone))[0].position)


def compare(options: Options, cloud: str, radius: float, order: str) -> dict[str, Any]:
    """Agreement and times on one cloud."""
    rng = np.random.default_rng(options.seed)
    draw = {"uniform": uniform, "surface": surface}[cloud]
    clouds = [draw(rng, options.points) for _ in range(jax.device_count())]
    if order == "coherent":
        clouds = [neighbors_together(points) for points in clouds]
    widths = options.channels, options.hidden
    layer = make_layer(clouds, radius, *widths, options.seed)
    mine = ours(layer)
    calls = {f"ours, {name}": call for name, call in mine.items()}
    case: dict[str, Any] = {"cloud": cloud, "radius": radius, "order": order}
    case |= {"missing": [], "edges": int(layer.edges.count.sum())}
    case["difference"] = float("nan")
    for name, peer in PEERS.items():
        try:
            theirs = peer(layer)
        except ImportError:
            case["missing"].append(name)
            continue
        case["difference"] = np.nanmax([case["difference"], check(mine, theirs)])
        calls |= {f"{name}, {part}": call for part, call in theirs.items()}
    try:
        calls["Open3D ContinuousConv, forward"] = in_open3d(layer, clouds[0], radius)
    except Exception as error:  # its builds refuse many versions of PyTorch
        case["missing"].append(f"Open3D ContinuousConv ({type(error).__name__})")
    return case | {"timings": measure(calls, options.repeats)}


def main(options: Options) -> dict[str, Any]:
    """Compare on two clouds in two orders; returns what metrics.json holds."""
    require(options, {"points": 100, "channels": 1, "hidden": 1, "repeats": 1})
    require_positive(options, "radii")
    require_some(options, "radii")
    begin = time.perf_counter()
    kinds = product(ORDERS, options.radii, ("uniform", "surface"))
    cases = [compare(options, c, r, order) for order, r, c in kinds]
    return write_cases(options, cases, write_report(options, cases), begin)


def write_report(options: Options, cases: list[dict[str, Any]]) -> str:
    """report.md: times and ratios, a row for each order, radius and cloud."""
    names = list(cases[0]["timings"])
    heads = ["order", "cloud", "radius", "edges", *names]
    peers = [name for name in PEERS if f"{name}, gradient" in names]
    heads += ["best / ours, forward", "best / ours, gradient"] if peers else []
    rows = []
    for case in cases:
        t = case["timings"]
        row = [
            case["order"],
            case["cloud"],
            case["radius"],
            case["edges"],
            *(str(t[n]) for n in names),
        ]
        if peers:
            row += [
                min(t[f"{name}, {part}"].median for name in peers)
                / t[f"ours, {part}"].median
                for part in ("forward", "gradient")
            ]
        rows.append(row)
    missing = sorted({name for case in cases for name in case["missing"]})
    return f"""# One Monte Carlo convolution

A batch of {jax.device_count()} clouds, one for every core, of {options.points} points,
{options.channels} channels, depth-wise, kernel perceptron
{INPUTS}-{options.hidden}-{options.hidden}-{options.channels}; "gradient" is forward and
gradient of all weights and features; edges given; median of {options.repeats} calls ±
half the interquartile range. Largest relative difference between ours and PyTorch's:
{max(case["difference"] for case in cases):.1e}.
Missing peers: {"; ".join(missing) or "none"}.

{describe()}

{report.markdown_table(heads, rows)}"""


if __name__ == "__main__":
    start(Options, main, QUICK)

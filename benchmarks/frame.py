"""Time of a whole frame of every effect, f_3D and f_2D, next to the paper's.

    python -m benchmarks.frame

From samples and a G-buffer in the host's memory to an image there; and the programs of
f_2D in blocks alone, as a GPU runs it, from the device's memory to the device's.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from benchmarks.paper_tables import PAPER_MS
from benchmarks.relight import lit_pair, sampled_and_seen
from benchmarks.timing import describe, measure, write_cases
from ginn_jax import block_shading, inference, report
from ginn_jax.architecture import Network
from ginn_jax.blocks import each_its_own, everywhere, make_turns
from ginn_jax.commandline import require, require_some, start
from ginn_jax.compare import SAMPLES
from ginn_jax.errors import InputError
from ginn_jax.evaluate import fill
from ginn_jax.example import numbers_asked
from ginn_jax.image import pixels_in_order, shade_image
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import network_numbers
from ginn_jax.network import Variables
from ginn_jax.presets import effect_of
from ginn_jax.pretrained import load_any
from ginn_jax.reference import GBuffer
from ginn_jax.samples import Samples
from ginn_jax.shading import Encoded
from ginn_jax.upsample import Surface


@dataclass(frozen=True)
class Options:
    """Time a frame of each effect."""

    out: Path = Path("runs/frame")
    """Folder for metrics.json and report.md."""
    networks: tuple[str, ...] = ("ao", "gi", "sss")
    """Trained networks: folders of runs, or names as "gi"."""
    resolution: int = 1024
    """Side of the frame in pixels."""
    points: int | None = None
    """Samples of the object; left out, as many as `experiments.evaluate` takes."""
    repeats: int = 15
    """Timed calls of each."""
    quick: bool = False
    """A small frame, few calls: to try things, not for numbers."""


QUICK = {"resolution": 64, "points": 4000, "repeats": 2, "networks": ("ao",)}


class Frame(NamedTuple):
    """Samples and a G-buffer, each with the material and light that a network takes."""

    cloud: Samples
    gbuffer: GBuffer
    of_cloud: tuple[Any, ...]
    of_pixels: tuple[Any, ...]


def make_frame(options: Options, network: Network, effect: str) -> Frame:
    """An object on its ground, or alone where it scatters, in random light."""
    points = options.points or SAMPLES[effect]
    cloud, seen = sampled_and_seen(network, points, options.resolution)
    if not network.lights:
        return Frame(cloud, seen, (None, None), (None, None))
    numbers, of_pixels = map(network_numbers, lit_pair(network, cloud, seen))
    images = (
        np.stack([fill(seen.mask, channel) for channel in number])
        for number in of_pixels
    )
    return Frame(cloud, seen, numbers, tuple(images))


def calls_of(
    network: Network, limits: Limits, variables: Variables, frame: Frame
) -> dict[str, Callable[[], Any]]:
    """What is timed, in limits that suffice."""
    cloud, seen = frame.cloud, frame.gbuffer
    key, pixels = jax.random.key(0), (seen.position, seen.normal, seen.mask)
    material, light = frame.of_pixels

    def encode(limits: Limits) -> tuple[Encoded, Limits]:
        ends = cloud.position, cloud.normal
        given = network, limits, variables, *ends, *frame.of_cloud
        return inference.encode_cloud(*given, key=key)

    def shade(limits: Limits, encoded: Encoded) -> tuple[np.ndarray, Limits]:
        given = network, limits, variables, encoded, *pixels
        return shade_image(*given, material=material, light=light)

    encoded, limits = encode(limits)
    _, limits = shade(limits, encoded)
    return {
        "f_3D": lambda: encode(limits)[0],
        "f_2D": lambda: shade(limits, encoded)[0],
        "frame": lambda: shade(limits, encode(limits)[0])[0],
        "f_2D in blocks, programs": programs(
            network, limits, variables, encoded, frame
        ),
    }


def programs(
    network: Network,
    limits: Limits,
    variables: Variables,
    encoded: Encoded,
    frame: Frame,
) -> Callable[[], Any]:
    """f_2D in blocks, with all that it needs on the devices and its results there."""
    seen = frame.gbuffer
    surface = Surface(seen.position, seen.normal, seen.mask)
    numbers = numbers_asked(network, *frame.of_pixels)
    _, pixels, coherent = pixels_in_order(network, encoded.center, surface, numbers)
    turns = make_turns(encoded.scale is not None, encoded.center, *pixels)
    turns = [each_its_own(turn) for turn in turns]
    ready = everywhere(block_shading.searchable(network, encoded))
    given = network, everywhere(variables), ready, turns, coherent, limits
    return partial(block_shading.shade_turns, *given)


def compare(options: Options, name: str) -> dict[str, Any]:
    """Times of one network's frame."""
    config, limits, variables = load_any(name)
    network, effect = config.network, effect_of(config.network)
    if effect is None:
        raise InputError(f"{name} is of no effect that the paper timed: name another")
    frame = make_frame(options, network, effect)
    begin = time.perf_counter()
    calls = calls_of(network, limits, variables, frame)
    ready = time.perf_counter() - begin
    return {
        "network": name,
        "points": len(frame.cloud.position),
        "pixels": int(frame.gbuffer.mask.sum()),
        "seconds_until_ready": ready,
        "paper_ms": PAPER_MS[effect]["ours"],
        "timings": measure(calls, options.repeats),
    }


def main(options: Options) -> dict[str, Any]:
    """Time a frame of every network; returns what metrics.json holds."""
    least = {"resolution": 16, "repeats": 1}
    require(options, least if options.points is None else least | {"points": 500})
    require_some(options, "networks")
    begin = time.perf_counter()
    cases = [compare(options, name) for name in options.networks]
    return write_cases(options, cases, write_report(options, cases), begin)


def write_report(options: Options, cases: list[dict[str, Any]]) -> str:
    """report.md: a row for each network."""
    names = list(cases[0]["timings"])
    heads = ["network", "points", "pixels", *names, "paper, ms", "compiling, s"]
    rows = [
        [c["network"], c["points"], c["pixels"]]
        + [str(c["timings"][name]) for name in names]
        + [c["paper_ms"], c["seconds_until_ready"]]
        for c in cases
    ]
    size = options.resolution
    return f"""# Whole frames

{size} x {size}, foreground pixels only; median of {options.repeats} calls ± half the
interquartile range. f_3D and f_2D from NumPy arrays to NumPy arrays (in lanes on a CPU,
by JAX on a GPU); "programs" are f_2D's in blocks with all they need on the
device and results left there. Rendering and light apart.
"Compiling" is the time until both had run once in limits that suffice. The paper's
whole network: 1024 x 1024, NVIDIA GTX 1080.

{describe()}

{report.markdown_table(heads, rows)}"""


if __name__ == "__main__":
    start(Options, main, QUICK)

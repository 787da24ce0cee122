"""What it saves to keep a scene that only changes its light.

    python -m benchmarks.relight

shades one object in RGB from scratch, and again under other lights with everything kept
that does not depend on the light; and a grey light, which takes one channel, not three.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from benchmarks.timing import Timing, circumstances, describe, measure
from ginn_jax import inference, objects, reference, report
from ginn_jax.architecture import Network
from ginn_jax.camera import orbit_camera
from ginn_jax.commandline import require, require_some, start
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model
from ginn_jax.limits import Limits
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.lit_views import encode_lit
from ginn_jax.pretrained import load_any
from ginn_jax.reference import GBuffer
from ginn_jax.relight import prepare_relighting, relight
from ginn_jax.samples import Samples
from ginn_jax.visible import visible_samples


@dataclass(frozen=True)
class Options:
    """Time relighting against shading from scratch."""

    out: Path = Path("runs/relight")
    """Folder for metrics.json and report.md."""
    resolution: int = 512
    """Side of the frame in pixels."""
    points: int = 20_000
    """Points of the cloud."""
    repeats: int = 7
    """Timed calls of each."""
    networks: tuple[str, ...] = ("gi", "sss")
    """Trained networks that take light: folders of runs, or names as "gi"."""
    quick: bool = False
    """A small frame, few calls: to try things, not for numbers."""


QUICK = {"resolution": 64, "points": 4000, "repeats": 2, "networks": ("gi",)}


def sampled_and_seen(
    network: Network, points: int, size: int
) -> tuple[Samples, GBuffer]:
    """An object, on its ground but where it scatters: samples of it, and a frame."""
    ground = not scatters(network)
    source = objects.procedural_sources(1, objects.BENCHMARK_SEED)[0]
    scene = reference.build_scene(objects.load_object(source, ground=ground))
    seen = reference.render_gbuffer(scene, orbit_camera(width=size, height=size))
    return visible_samples(scene, points, 0, ground), seen


def scatters(network: Network) -> bool:
    """Whether the network is one of subsurface scattering."""
    return network.materials == 3


def lit_pair(
    network: Network, cloud: Samples, seen: GBuffer
) -> tuple[LitCloud, LitCloud]:
    """A cloud and the foreground pixels of a frame, in random light."""
    pixels = Samples(
        *(a[seen.mask] for a in (seen.position, seen.normal, seen.material))
    )
    medium = np.array([10.0, 1.3]) if scatters(network) else np.zeros(0)
    return in_random_light(cloud, medium, 0), in_random_light(pixels, medium, 1)


def in_random_light(samples: Samples, medium: np.ndarray, seed: int) -> LitCloud:
    """Points with light of any colour; times do not depend on it."""
    rng = np.random.default_rng(seed)
    light = rng.gamma(1.0, size=samples.position.shape).astype(np.float32)
    albedo = np.array([[0.7, 0.5, 0.3], [0.4, 0.5, 0.6]], np.float32)
    position, normal, material = samples
    return LitCloud(position, normal, material, light, light, light, albedo, medium)


def compare(options: Options, name: str) -> dict[str, Any]:
    """Times of one network: from scratch, relit, and in grey light."""
    config, limits, variables = load_any(name)
    network = config.network
    if not network.lights:
        raise InputError(f"{name} takes no light: name one of gi or of sss")
    made = sampled_and_seen(network, options.points, options.resolution)
    cloud, pixels = lit_pair(network, *made)
    model = Model(variables, jax.random.key(0))
    scratch, limits = from_scratch(network, limits, model, cloud, pixels)
    grey = [
        c._replace(
            irradiance=np.repeat(c.irradiance[:, :1], 3, axis=1),
            albedo=np.repeat(c.albedo[:, :1], 3, axis=1),
        )
        for c in (cloud, pixels)
    ]
    ready, _ = prepare_relighting(
        network, limits, variables, cloud, pixels, key=model.key
    )
    calls = {
        "from scratch": scratch,
        "relit": lambda: relight(network, variables, ready, cloud, pixels),
        "from scratch, grey": from_scratch(network, limits, model, *grey)[0],
    }
    difference = np.abs(calls["relit"]() - np.maximum(scratch(), 0.0)).max()
    times = measure(calls, options.repeats)
    return row_of(times) | {
        "network": name,
        "pixels": len(pixels.position),
        "kept_mib": sum(a.nbytes for a in jax.tree.leaves(ready)) / 2**20,
        "largest_difference": float(difference),
        "timings": {name: t.record() for name, t in times.items()},
    }


def from_scratch(
    network: Network,
    limits: Limits,
    model: Model,
    cloud: LitCloud,
    pixels: LitCloud,
) -> tuple[Callable[[], Any], Limits]:
    """A call that shades the pixels from nothing, and limits that hold it."""

    def shade(limits: Limits) -> tuple[np.ndarray, Limits]:
        given = network, limits, model, cloud
        encoded, limits = encode_lit(*given, merge_grey=True)
        channels = 3 if encoded.scale is None else encoded.scale.size
        material, lit = (a[:channels] for a in network_numbers(pixels))
        ends = model.variables, encoded, pixels.position, pixels.normal
        return inference.shade_points(network, limits, *ends, material, lit)

    limits = shade(limits)[1]
    return lambda: shade(limits)[0], limits


def row_of(times: dict[str, Timing]) -> dict[str, Any]:
    """Medians in ms, and what relighting and grey light save."""
    scratch, relit, grey = (t.median for t in times.values())
    return {
        "scratch_ms": 1e3 * scratch,
        "relit_ms": 1e3 * relit,
        "grey_ms": 1e3 * grey,
        "saving": scratch / relit,
        "grey_saving": scratch / grey,
    }


def main(options: Options) -> dict[str, Any]:
    """Time all networks; returns what metrics.json holds."""
    require(options, {"resolution": 16, "points": 1000, "repeats": 1})
    require_some(options, "networks")
    begin = time.perf_counter()
    rows = [compare(options, name) for name in options.networks]
    metrics = {"rows": rows} | circumstances(options, begin)
    heads = {"network": "network", "pixels": "pixels", "scratch_ms": "from scratch ms"}
    heads |= {"relit_ms": "relit ms", "saving": "saving", "grey_ms": "grey ms"}
    heads |= {"grey_saving": "saving", "kept_mib": "kept MiB"}
    text = f"""# Relighting

{describe()}

One object, {options.points} points, {options.resolution} x {options.resolution}, RGB;
medians of {options.repeats} calls in turns, compilation apart. Relit: hierarchy,
neighbours and kernel values are kept, and give the same values (largest difference
{max(r["largest_difference"] for r in rows):.1e} in light of mean 1). Grey: from
scratch, one channel instead of three.

{report.table_of(rows, heads)}"""
    report.write_results(options.out, metrics, text)
    return metrics


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

"""Put the weights of a finished run into the package.

    python -m experiments.export --run runs/gi_train --name gi \\
        --command "python -m experiments.gi_train"

writes NAME.npz and the record of the run, with the network's error on one fixed scene,
by which a test tells that the weights are the ones measured.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import jax
import numpy as np
from rich.console import Console

from ginn_jax import compare, evaluate, evaluate_light
from ginn_jax.architecture import Network
from ginn_jax.checkpoint import load_weights
from ginn_jax.commandline import start
from ginn_jax.dataset import count_asked
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model
from ginn_jax.limits import Limits
from ginn_jax.lit_scenes import lit_cloud
from ginn_jax.objects import (
    BENCHMARK_SEED,
    load_object,
    procedural_lights,
    procedural_sources,
)
from ginn_jax.pairing import pair_up
from ginn_jax.presets import effect_of
from ginn_jax.pretrained import FOLDER, export
from ginn_jax.scenes import Occlusion, occlusion_cloud

FIXED_POINTS, FIXED_COUNT = 20_000, 64


@dataclass(frozen=True)
class Options:
    """Export a run's weights."""

    run: Path
    """The --out of a finished training run."""
    name: str
    """Effect, "ao", "gi" or "sss", and what sets it apart: "gi", "gi_only_2d"."""
    command: str
    """The command that trained it, for the record."""
    folder: Path = FOLDER
    """Where to."""


def main(options: Options) -> Path:
    """Write the files; returns the path of the weights."""
    config, limits, weights = load_weights(options.run)
    effect = options.name.split("_")[0]
    if effect != effect_of(config.network):
        raise InputError(
            f"--name is {options.name}: let it begin with ao, gi or sss, whichever "
            f"{options.run} learned"
        )
    model = Model(weights, jax.random.key(0))
    error = fixed_scene_error(effect, config.network, limits, model)
    more = {"command": options.command, "fixed_scene_relative_mse_3d": error}
    path = export(options.run, options.name, more, options.folder)
    size = path.stat().st_size / 1024
    Console().print(f"{path}: {size:.0f} KiB, {error:.4f} on the fixed scene")
    return path


def fixed_scene_error(
    effect: str, network: Network, limits: Limits, model: Model
) -> float:
    """Relative 3D MSE of a network on one small procedural scene."""
    settings = compare.effect_settings(effect, FIXED_POINTS, FIXED_COUNT, 0.1)
    source = procedural_sources(1, BENCHMARK_SEED)[0]
    if isinstance(settings, Occlusion):
        cloud = occlusion_cloud(load_object(source), settings, source.seed)
        given = network, limits, model, [cloud], [source.name]
        rows, _ = evaluate.evaluate_clouds(*given, FIXED_COUNT)
    else:
        settings = replace(settings, targets=count_asked(FIXED_POINTS))
        source = pair_up([source], procedural_lights(1, BENCHMARK_SEED), 1)[0]
        given = network, limits, model, [lit_cloud(source, settings)], [source.name]
        rows, _ = evaluate_light.evaluate_lit_clouds(*given, settings)
    return float(np.float32(rows[0]["relative_mse_3d"]))


if __name__ == "__main__":
    start(Options, main, {}, __doc__)

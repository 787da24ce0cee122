"""Global illumination from nothing to a trained network, images and tables.

    python -m experiments.gi_train --out runs/gi_train

lights procedural shapes with procedural skies and studios, path-traces direct and
indirect irradiance, trains, and evaluates on shapes and lights that training never saw.
`--help` lists every option with its default.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ginn_jax.commandline import start
from ginn_jax.lit_experiment import check_lit_run, run_experiment
from ginn_jax.lit_options import QUICK, LitOptions, Preset
from ginn_jax.lit_scenes import Illumination
from ginn_jax.presets import ILLUMINATION


@dataclass(frozen=True)
class Options(LitOptions):
    """Train global illumination on point clouds and evaluate it on unseen scenes."""

    out: Path = Path("runs/gi_train")
    """Folder for data, checkpoints, metrics.json, report.md and figures."""
    preset: Preset = "homogeneous"
    """Homogeneous in light, the same half or twice as wide, exactly linear, the
    authors' table, or an ablation."""


def main(options: Options) -> dict[str, Any]:
    """Run the experiment; returns what metrics.json holds."""
    check_lit_run(options)
    settings = Illumination(options.points, options.paths)
    network = ILLUMINATION[options.preset]
    return run_experiment(options, settings, network, "Global illumination")


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

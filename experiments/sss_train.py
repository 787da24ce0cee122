"""Subsurface scattering from nothing to a trained network, images and tables.

    python -m experiments.sss_train --out runs/sss_train

fills procedural shapes with random media, lights them with procedural skies and
studios, walks light through them, trains, and evaluates on shapes, media and lights
that training never saw. `--help` lists every option with its default.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ginn_jax.commandline import start
from ginn_jax.errors import InputError
from ginn_jax.lit_experiment import check_lit_run, run_experiment
from ginn_jax.lit_options import QUICK, LitOptions, Preset
from ginn_jax.lit_scenes import Scattering
from ginn_jax.presets import SCATTERING


@dataclass(frozen=True)
class Options(LitOptions):
    """Train subsurface scattering on point clouds and evaluate it on unseen scenes."""

    out: Path = Path("runs/sss_train")
    """Folder for data, checkpoints, metrics.json, report.md and figures."""
    preset: Preset = "homogeneous"
    """Homogeneous in light, the same half or twice as wide, exactly linear, the
    authors' table, or an ablation."""
    paths: int = 16
    """Paths per training point."""
    steps: int = 1500
    """Training steps."""
    size: float = 100.0
    """Longest side of the objects in mm."""
    absorption: float = 0.1
    """Mean reduced absorption coefficient of the media in 1/mm."""


def main(options: Options) -> dict[str, Any]:
    """Run the experiment; returns what metrics.json holds."""
    check_lit_run(options)
    if not (options.size > 0 and options.absorption > 0):
        raise InputError("--size and --absorption must be positive")
    settings = Scattering(
        options.points,
        options.paths,
        size=options.size,
        absorption=options.absorption,
    )
    network = SCATTERING[options.preset]
    return run_experiment(options, settings, network, "Subsurface scattering")


if __name__ == "__main__":
    start(Options, main, QUICK, __doc__)

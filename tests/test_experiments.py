"""The scripts as a user meets them: help, mistakes, a small run from nothing."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import jax
import pytest
import tiny

from experiments import ao_train
from ginn_jax import experiment
from ginn_jax.errors import InputError

ROOT = Path(__file__).parents[1]
KEYS = (
    "mse_3d",
    "relative_mse_3d",
    "noise_floor_3d",
    "equal_rays",
    "mse_2d",
    "dssim_2d",
    "seconds_total",
    "seconds_data",
    "seconds_compile",
    "seconds_train",
    "steps",
    "unseen shapes",
)
SMALL = ao_train.Options(
    shapes=2,
    test_shapes=2,
    rays=8,
    points=1000,
    test_points=1000,
    steps=2,
    resolution=32,
    disk=0.9,
    quick=True,
)


def command(*words):
    return subprocess.run(
        [sys.executable, "-m", "experiments.ao_train", *words],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )


def test_help_names_every_option():
    said = command("--help")
    assert said.returncode == 0
    for name in ao_train.Options.__dataclass_fields__:
        assert "--" + name.replace("_", "-") in said.stdout


def test_mistakes_end_in_one_line_and_code_2(tmp_path):
    """Those of every other kind do so in `test_bad_scripts`, in this process."""
    words = "--out", str(tmp_path), "--test-meshes", "no/such/folder"
    said = command(*words)
    assert said.returncode == 2
    assert len(said.stderr.strip().splitlines()) == 1
    assert "no/such/folder" in said.stderr
    assert "Traceback" not in said.stderr


@pytest.mark.parametrize(
    "wrong",
    [
        {"rays": 1},
        {"points": 10},
        {"test_points": 10},
        {"steps": 0},
        {"radius": float("nan")},
        {"radius": -1.0},
        {"start": "no_such_run"},
        {"start": "runs/one", "out": Path("runs/one")},
    ],
)
def test_options_that_cannot_be_meant_are_refused(wrong):
    flag = next(iter(wrong)).replace("_", "-")
    with pytest.raises(InputError, match=f"--{flag}|no_such_run"):
        ao_train.main(replace(SMALL, **wrong))


@pytest.mark.usefixtures("small_programs")
def test_a_small_run_leaves_all_that_is_promised(tmp_path, monkeypatch):
    monkeypatch.setitem(ao_train.presets.PRESETS, "default", tiny.ONE_LEVEL)
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        ao_train.main(replace(SMALL, out=tmp_path))
    metrics = json.loads((tmp_path / "metrics.json").read_text())
    assert not [key for key in KEYS if key not in metrics]
    assert metrics["steps"] == 2
    network = metrics["training"]["network"]
    assert network["levels"] == pytest.approx([0.9 * tiny.ONE_LEVEL.levels[0]])
    assert len(metrics["unseen shapes, each"]) == 2
    rays = [r["mse_2d"] for r in metrics["error_against_time"] if "rays" in r]
    assert rays == sorted(rays, reverse=True)
    for name in ("learning_curve", "views", "error_against_time"):
        assert (tmp_path / f"{name}.png").stat().st_size > 1000
    text = (tmp_path / "report.md").read_text()
    assert "unseen shapes | 2 |" in text
    assert "rays of equal MSE" in text


def test_nothing_to_train_on_is_said_before_data_are_made(tmp_path):
    with pytest.raises(InputError, match="no training clouds: ask for at least one"):
        ao_train.main(replace(SMALL, shapes=0, out=tmp_path))
    assert not list(tmp_path.rglob("*.npz"))


def test_pace_of_a_resumed_run_is_its_own():
    """2,900 steps came before it, and a minute went by until the first was told."""
    told = [(2910, 60.0), (2920, 65.0), (2960, 75.0)]
    assert experiment.pace(told) == ", 3.3 steps/s"
    assert experiment.pace(told[:1]) == ""

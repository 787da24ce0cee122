"""The benchmarks run and say what they should; how long things take is not tested."""

from dataclasses import replace
from functools import partial
from inspect import unwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from left_behind import check_files

from benchmarks import (
    f2d,
    neighbors,
    poisson_radii,
    scaling,
    timing,
    train_step,
)
from ginn_jax import blocks, presets
from ginn_jax.commandline import hasten
from ginn_jax.disk_radius import with_disk_radius
from ginn_jax.errors import InputError

pytestmark = pytest.mark.usefixtures("at_once")


def test_quick_keeps_what_the_user_gave():
    options = neighbors.Options(points=77, quick=True)
    assert hasten(options, neighbors.QUICK).points == 77
    assert hasten(options, neighbors.QUICK).queries == neighbors.QUICK["queries"]


def test_disks_of_the_benchmark_suit_every_network():
    for effect in (presets.PRESETS, presets.ILLUMINATION, presets.SCATTERING):
        network = next(iter(effect.values()))
        for factor in poisson_radii.Options.times:
            with_disk_radius(network, factor * network.levels[0])


def test_train_step(tmp_path, monkeypatch):
    stand_in(monkeypatch)
    monkeypatch.setitem(presets.PRESETS, "default", tiny.ONE_LEVEL)
    monkeypatch.setattr(train_step, "training_room", lambda *_: tiny.ONE_LEVEL_ROOM)
    options = train_step.Options(
        tmp_path, shapes=1, batch=1, points=600, queries=64, repeats=1
    )
    stages = ("geometry", "step")
    some = {name: train_step.STAGES[name] for name in stages}
    monkeypatch.setattr(train_step, "STAGES", some)
    monkeypatch.setattr(train_step, "train_step", step_of_ones(train_step.train_step))
    with jax.numpy_dtype_promotion("standard"), tiny.cheap_compiling():
        metrics = train_step.main(options)
    assert list(metrics["columns"]["one cloud"]["added"]) == list(stages)
    assert "a third of" in (tmp_path / "report.md").read_text()
    check_files(tmp_path, "train_step.png")


def test_a_stage_adds_what_it_takes_beyond_the_one_before():
    timings = [timing.Timing(0.0, (seconds,)) for seconds in (2.0, 5.0, 4.5)]
    assert train_step.differences(timings) == [2.0, 3.0, -0.5]


def step_of_ones(step):
    """The step's shapes without its compilation: it has tests of its own."""

    def traced(config, limits, *arrays):
        shapes = jax.eval_shape(partial(unwrap(step), config, limits), *arrays)
        return jax.tree.map(lambda s: jnp.ones(s.shape, s.dtype), shapes)

    return traced


@pytest.mark.parametrize("stage", ["levels", "edges", "forward", "gradient"])
def test_stages_of_the_step(stage):
    """Traced only: compiling them takes long and adds nothing."""
    config = replace(tiny.CONFIG, network=tiny.ONE_LEVEL)
    setting = config, tiny.ONE_LEVEL_LIMITS, stage, untrained(config), tiny.batch()
    call = train_step.stage_call(*setting)
    first, second = call.func.eval_shape(*call.args)
    rows = tiny.ONE_LEVEL_LIMITS.sizes[0][1]
    if stage == "levels":
        assert first[0].position.shape == (1, rows, 3)
    elif stage == "edges":
        assert [edges[0].shape for edges in (first, second)] == [(1, rows)] * 2
    else:
        assert set(second) == set(dict(tiny.ONE_LEVEL_LIMITS.sizes))
        assert isinstance(first[0], tuple) == (stage == "gradient")


def test_f2d(tmp_path, monkeypatch):
    """In lanes, in blocks and straightforward: all agree, or `compare` raises."""
    stand_in(monkeypatch)
    monkeypatch.setattr(f2d, "compact_network", lambda **_: tiny.ONE_LEVEL)
    options = f2d.Options(
        tmp_path,
        resolution=48,
        points=700,
        disks=(0.08,),
        radii=(0.16,),
        scales=(0.5,),
        rays=(1,),
        repeats=1,
    )
    with tiny.cheap_compiling():
        case = f2d.main(options)["cases"][0]
    assert case["difference"] < 1e-5
    assert case["edges"] > case["pixels"] > 500
    assert case["block_bytes"] > 0
    assert set(case["timings"]) == {
        "ours",
        "ours, scale 1/2",
        "in blocks",
        "straightforward",
        "1 rays",
    }
    text = (tmp_path / "report.md").read_text()
    assert "straightforward / ours" in text


def test_scaling(tmp_path, monkeypatch):
    stand_in(monkeypatch)
    monkeypatch.setattr(scaling, "network_for", lambda _: tiny.ONE_LEVEL)
    monkeypatch.setattr(scaling, "FRAME_POINTS", 700)
    options = scaling.Options(
        tmp_path, points=(600, 700), resolutions=(32, 64), repeats=1
    )
    with tiny.cheap_compiling():
        metrics = scaling.main(options)
    sizes = [row["size"] for row in metrics["tables"]["pixels"]]
    assert 3 < sizes[1] / sizes[0] < 5
    assert len({row["scratch_mib"] for row in metrics["tables"]["pixels"]}) == 1
    assert np.isfinite(list(metrics["slopes"].values())).all()
    check_files(tmp_path, "scaling.png")


def test_slope_of_a_power_law():
    rows = [
        {"size": n, "timing": timing.Timing(0.0, (3e-6 * n**1.5,))}
        for n in (8, 64, 999)
    ]
    assert scaling.slope(rows) == pytest.approx(1.5)


def test_mistakes_are_input_errors(tmp_path, monkeypatch):
    stand_in(monkeypatch)
    with pytest.raises(InputError, match="--radii"):
        neighbors.main(neighbors.Options(tmp_path, radii=(0.1, -1.0)))
    with pytest.raises(InputError, match="--repeats is 0"):
        train_step.main(train_step.Options(tmp_path, repeats=0))
    with pytest.raises(InputError, match="Poisson radius"):
        poisson_radii.main(poisson_radii.Options(out=tmp_path, times=(7.0,)))


def stand_in(monkeypatch):
    """Networks that compile in seconds, untrained, with limits that suffice at once."""
    monkeypatch.setattr(presets, "DEFAULT", tiny.ONE_LEVEL)
    for module in (f2d, scaling, train_step):
        monkeypatch.setattr(module, "init_state", untrained)
    for module in (f2d, scaling):
        monkeypatch.setattr(module, "uniform_limits", lambda *_: tiny.ONE_LEVEL_LIMITS)
    # Every frame has full blocks, so one shape is compiled.
    monkeypatch.setattr(blocks, "BLOCK", 256)


def untrained(config):
    """The first state of a network, compiled once for all tests."""
    return tiny.fresh_state(replace(tiny.CONFIG, network=config.network))

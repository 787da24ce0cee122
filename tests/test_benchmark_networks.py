"""Networks that train for the same time, and how long one of their steps takes."""

from dataclasses import fields, replace

import jax
import numpy as np
import pytest
import tiny

from benchmarks import departures, networks
from ginn_jax import compare_networks
from ginn_jax.presets import PAPER
from ginn_jax.run_record import RECORD, read_record


@pytest.mark.usefixtures("small_programs")
def test_networks_at_equal_time(tmp_path, monkeypatch):
    """As many steps as fit the time; a row for each, of the same unseen scenes."""
    network = replace(tiny.ONE_LEVEL, lights=1, materials=1)
    # Under two names, of which the second is said to be faster: compiled once.
    table = {"homogeneous": network, "linear": network}
    monkeypatch.setattr(networks, "ILLUMINATION", table)
    seconds = iter([0.5, 0.3])
    monkeypatch.setattr(networks, "step_seconds", lambda *_: next(seconds))
    room = tiny.ample_room(network)
    monkeypatch.setattr("ginn_jax.fit.training_room", lambda *_: room)
    options = networks.Options(
        tmp_path,
        presets=tuple(table),
        seconds=1.1,
        shapes=2,
        test_shapes=1,
        points=1000,
        paths=2,
        resolution=32,
        quick=True,
    )
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        rows = networks.main(options)["rows"]
    found = [(row["preset"], row["steps"]) for row in rows]
    assert found == [("homogeneous", 2), ("linear", 4)]
    for row in rows:
        for name in ("shapes", "point lights"):
            assert np.isfinite(row[f"relative, {name}"])
    assert "homogeneous" in (tmp_path / "report.md").read_text()


def test_step_is_timed_once_it_is_compiled_and_has_room(monkeypatch):
    """A step that compiles, or that is repeated in more room, does not count."""
    found = iter(["small", None, "large", "large", "large"])
    ticks = iter(range(100))

    def step(config, room, clouds, state):
        used = next(found)
        return state, 0.0, used, room

    monkeypatch.setattr(networks, "PROBE", 2)
    monkeypatch.setattr(networks.fit, "step_with_room", step)
    monkeypatch.setattr(networks, "training_room", lambda *_: None)
    monkeypatch.setattr(networks, "init_state", lambda *_: None)
    monkeypatch.setattr(networks.time, "perf_counter", lambda: next(ticks) ** 2)
    # The fourth and the fifth; begun at 4 and 6 (or so), over at 5 and 7.
    assert networks.step_seconds(None, []) == ((4**2 - 3**2) + (6**2 - 5**2)) / 2
    assert next(found, "none left") == "none left"


def test_every_departure_is_left_out_alone_and_all_at_once():
    given = departures.variants(departures.DEFAULT, 3)
    found = {name: variant.network for name, variant in given.items()}
    ours, bare = found["ours"], found["without any"]

    def changes(network):
        pairs = ((f.name, getattr(network, f.name)) for f in fields(network))
        return {name for name, value in pairs if value != getattr(ours, name)}

    changed = {name: changes(network) for name, network in found.items()}
    for name, change in departures.WITHOUT.items():
        assert changed[f"without {name}"] == set(change)
    assert changed["without any"] == set().union(*departures.WITHOUT.values())
    same = "oriented", "density", "norm", "sided", "taper"
    assert [getattr(bare, n) for n in same] == [getattr(PAPER, n) for n in same]
    trained = {
        name: departures.run_of(departures.Options(seed=3), name, variant.training)
        for name, variant in given.items()
    }
    assert len({run.out for run in trained.values()}) == len(given)
    assert [n for n, run in trained.items() if run.seed != 3] == ["ours, other weights"]
    adam = [n for n, run in trained.items() if run.schedule == "paper"]
    assert adam == ["the paper's table and optimiser"]
    assert found[adam[0]] == PAPER


@pytest.mark.usefixtures("small_programs")
def test_departures(tmp_path, monkeypatch):
    network, room = tiny.ONE_LEVEL, tiny.ONE_LEVEL_ROOM
    only = {"ours": departures.Variant(network, {})}
    monkeypatch.setattr(departures, "variants", lambda *_: only)
    monkeypatch.setattr("ginn_jax.fit.training_room", lambda *_: room)
    options = departures.Options(
        tmp_path, steps=2, shapes=2, test_shapes=1, points=1000, rays=4, resolution=32
    )
    with tiny.cheap_compiling(), jax.numpy_dtype_promotion("standard"):
        [row] = departures.main(options)["rows"]
    assert np.isfinite(row["relative, shapes"])
    assert row["3d_ms"] > 0 < row["2d_ms"]
    assert "ours" in (tmp_path / "report.md").read_text()
    # For those who compare it with other runs.
    assert compare_networks.learned_from(str(tmp_path / "ours"))["radius"] == 0.1
    assert "shape_0" in read_record(tmp_path / "ours" / RECORD, "")["objects"]

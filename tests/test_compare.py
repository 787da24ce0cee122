"""Comparisons: fronts and lost cells by definition, methods on the same pixels."""

import json
import re
import sys
from dataclasses import replace
from types import SimpleNamespace

import jax
import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st

from experiments import evaluate as experiment
from ginn_jax import checkpoint, pretrained, report, run_record, scenes
from ginn_jax.compare_figures import inset_place
from ginn_jax.compare_networks import OURS, others_beside, redrawn, warn_of_seen
from ginn_jax.compare_report import (
    RIVALS,
    lost_cells,
    pareto_front,
)
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model, mean_rows

numbers = st.floats(1e-3, 1e3)
rows = st.lists(st.tuples(numbers, numbers), min_size=1, max_size=12).map(
    lambda pairs: [
        {"method": str(i), "seconds": s, "mse_2d": e} for i, (s, e) in enumerate(pairs)
    ]
)


@given(rows)
def test_front_is_what_nothing_beats(rows):
    front = set(pareto_front(rows))
    for row in rows:
        beaten = any(
            r["seconds"] <= row["seconds"]
            and r["mse_2d"] <= row["mse_2d"]
            and (r["seconds"], r["mse_2d"]) != (row["seconds"], row["mse_2d"])
            for r in rows
        )
        twins = [
            r["method"]
            for r in rows
            if (r["seconds"], r["mse_2d"]) == (row["seconds"], row["mse_2d"])
        ]
        assert bool(front & set(twins)) == (not beaten)


def test_lost_cells_are_those_a_rival_wins():
    ours = {"method": OURS, "mse_3d": 0.1, "mse_2d": 0.1, "dssim_2d": 0.1}
    others = [{"method": r, "mse_2d": 0.2, "dssim_2d": 0.2} for r in RIVALS]
    assert lost_cells([ours, *others]) == []
    others[RIVALS.index("2D only")] |= {"mse_3d": 0.05}
    others[0] |= {"dssim_2d": 0.09}
    lost = lost_cells([ours, *others])
    assert len(lost) == 2
    assert lost[0].startswith("mse_3d: 2D only 0.05")
    assert lost[1].startswith("dssim_2d: screen space 0.09")
    fast = {"method": "4 paths", "mse_2d": 0.0, "dssim_2d": 0.0}
    assert len(lost_cells([ours, *others, fast])) == 2


def test_pooled_relative_error_is_a_ratio_of_means():
    shots = [
        {"method": "a", "mse_2d": 1.0, "variance_2d": 1.0, "relative_mse_2d": 1.0},
        {"method": "a", "mse_2d": 1.0, "variance_2d": 9.0, "relative_mse_2d": 1 / 9},
    ]
    [pooled] = mean_rows(shots)
    assert pooled["relative_mse_2d"] == pytest.approx(0.2)
    assert pooled["shots"] == 2


def test_tracing_is_put_beside_what_is_not_traced():
    """Rays for the same MSE and their time; MSE at equal time over one's own."""
    mine = {"method": OURS, "mse_2d": 0.5, "seconds": 6.0}
    traced = [{"rays": n, "mse_2d": 4 / n, "seconds": 1.0 + 2 * n} for n in (2, 1)]
    others = [*traced, {"denoised": 1, "mse_2d": 0.1, "seconds": 9.0}]
    first, *rest = report.beside_tracing([mine, *others], "rays")
    added = {"equal_count": 8, "equal_seconds": 17, "equal_time": 4 / 2.5 / 0.5}
    assert {name: first[name] for name in added} == pytest.approx(added)
    assert mine.items() <= first.items()
    assert rest == others
    assert report.beside_tracing([mine, traced[0]], "rays") == [mine, traced[0]]


def test_inset_lies_where_the_reference_varies():
    image = np.ones((100, 100, 3))
    image[70:80, 20:30] += np.random.default_rng(0).uniform(0, 1, (10, 10, 1))
    (row, column), size = inset_place(image)
    assert row <= 75 <= row + size
    assert column <= 25 <= column + size


pytestmark = pytest.mark.usefixtures("cheap_compiling")


SETTINGS = scenes.Occlusion(2000, 8, radius=0.1)
LEARNED = {"data": {"radius": 0.1}, "objects": ["cat", "duck__noon"]}


def finished_run(folder, network=tiny.ONE_LEVEL):
    """A folder as a training run leaves it, of the tiny untrained network."""
    folder.mkdir()
    config = replace(tiny.CONFIG, network=network)
    run_record.save_run(folder, config, tiny.ONE_LEVEL_ROOM, LEARNED)
    manager = checkpoint.open_manager(folder, fresh=True)
    checkpoint.save_state(manager, tiny.fresh_state(config, tiny.ONE_LEVEL_LIMITS))
    manager.close()
    return folder


def test_draws_are_distinct_and_none_is_the_networks_own():
    own = tiny.NETWORK, tiny.LIMITS, Model({}, jax.random.key(3))
    drawn = [own, *redrawn(own, 3)]
    keys = [tuple(jax.random.key_data(model.key).tolist()) for _, _, model in drawn]
    assert len(keys) == len(set(keys)) == 3


def test_runs_beside_need_names_of_their_own(tmp_path):
    runs = [str(tmp_path / folder / "wide") for folder in ("one", "two")]
    with pytest.raises(InputError, match="one name"):
        others_beside("ao", SETTINGS, runs, key=jax.random.key(0))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("gi", "gi is no network of ao"),
        ("sss_only_2d", "sss_only_2d is no network of ao"),
        ("nothing", "no trained network 'nothing'"),
    ],
)
def test_networks_beside_are_of_the_same_effect(name, message):
    with pytest.raises(InputError, match=message):
        others_beside("ao", SETTINGS, [name], key=jax.random.key(0))


def test_networks_of_the_package_stand_beside_by_name():
    found = others_beside("ao", SETTINGS, ["ao_only_2d"], key=jax.random.key(0))
    network, _, _ = found["run ao_only_2d"]
    assert network == pretrained.load_pretrained("ao_only_2d")[0].network


@pytest.mark.parametrize(
    ("scene", "seen"),
    [("cat", "cat"), ("cat__noon", "cat, noon"), ("dog__noon", "noon"), ("dog", "")],
)
def test_scenes_that_a_run_trained_on_are_named(scene, seen, tmp_path, caplog):
    run_record.save_run(tmp_path, tiny.CONFIG, tiny.ROOM, LEARNED)
    warn_of_seen((None, "ao", str(tmp_path)), ["cow__dusk", scene])
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == bool(seen)
    assert not seen or f"called {seen}: " in said[0]


@pytest.mark.usefixtures("small_programs")
def test_light_is_compared_with_tracing_plain_and_denoised(tmp_path, monkeypatch):
    """By a denoiser that leaves the image as it is, or makes it half as bright."""
    network = replace(tiny.ONE_LEVEL, lights=1, materials=3, asks="all", local=True)
    asked = []

    def denoise(color, albedo, normal, hdr, clean_aux, quality):
        asked.append((color.shape, albedo.shape, normal.shape, hdr, clean_aux))
        return color / quality

    oidn = SimpleNamespace(denoise=denoise, Quality={"High": 1, "Fast": 2})
    monkeypatch.setitem(sys.modules, "mitsuba_oidn", oidn)
    ours = finished_run(tmp_path / "ours", network)
    splats = finished_run(tmp_path / "splats", replace(network, splat=True))
    options = experiment.Options(
        "sss",
        out=tmp_path / "out",
        checkpoint=str(ours),
        only_2d=str(ours),
        only_3d=str(splats),
        objects=1,
        views=1,
        resolution=40,
        reference=8,
        counts=(2,),
        disks=(0.75,),
        scales=(0.5,),
        draws=2,
        points=1500,
        looks=16,
        fewer_looks=(4,),
    )
    found = experiment.main(options)
    rows = {row["method"]: row for row in found["error_against_time"]}
    assert rows["ours, mean of 2"]["seconds"] > rows[OURS]["seconds_3d"]
    assert {"ours, disk 0.06", "ours, scale 1/2", "3D only"} <= set(rows)
    kept = rows["ours, codes kept"]
    assert kept["mse_2d"] == rows[OURS]["mse_2d"]
    assert kept["seconds"] == rows[OURS]["seconds_2d"] < rows[OURS]["seconds"]
    plain, denoised = rows["2 paths"], rows["2 paths, denoised"]
    assert denoised["mse_2d"] == pytest.approx(plain["mse_2d"], rel=1e-5)
    assert denoised["seconds"] > plain["seconds"]
    quick = rows["2 paths, denoised fast"]
    assert quick["mse_2d"] != denoised["mse_2d"]
    assert asked[0] == (*[(40, 40, 3)] * 3, True, True)
    half = rows["ours, 0.5 of samples"]["mse_2d"]
    assert half != rows[OURS]["mse_2d"]
    assert "ours, 0.5 of samples, scale 1/2" in rows
    counted = {row["method"]: row for row in found["light_counted"]}
    assert len(counted) == 2 * 2 * 2
    whole, fewer = (counted[f"ours, {n} looks"] for n in (16, 4))
    assert whole["mse_2d"] == pytest.approx(rows[OURS]["mse_2d"], rel=1e-3)
    assert fewer["mse_2d"] != whole["mse_2d"]
    fewer = counted["ours, 0.5 of samples, 16 looks"]
    assert fewer["mse_2d"] == pytest.approx(half, rel=1e-3)
    for row in counted.values():
        parts = "network", "sampling", "samples", "pixels"
        parts = [row[f"seconds_{part}"] for part in parts]
        assert min(parts) > 0
        assert row["seconds"] == pytest.approx(sum(parts))
    text = (tmp_path / "out" / "report.md").read_text()
    assert "With samples and direct light counted" in text
    assert f"`{found['command']}`, 1 unseen" in text
    assert "--counts 2 --disks 0.75" in found["command"]
    noise = found["results"][0]["noise_dssim"]
    assert 0 < noise < rows["2 paths"]["dssim_2d"]
    results = {row["method"]: row for row in found["results"]}
    for name in (OURS, "2D only", "3D only"):
        assert results[name]["relative_mse_3d"] > 0
    assert results[OURS]["mse_3d"] == results["2D only"]["mse_3d"]


@pytest.mark.usefixtures("small_programs")
def test_comparison_ends_in_a_report_and_keeps_its_references(tmp_path):
    run = finished_run(tmp_path / "run")
    options = experiment.Options(
        "ao",
        out=tmp_path / "out",
        checkpoint=str(run),
        only_2d=str(run),
        only_3d=str(run),
        beside=(str(run),),
        objects=1,
        views=1,
        resolution=48,
        reference=16,
        counts=(1, 4),
        disks=(),
        scales=(0.5,),
        shares=(),
        draws=2,
        points=2000,
    )
    first = experiment.main(options)
    names = [row["method"] for row in first["results"]]
    assert names == ["screen space", "visibility bitmask", OURS, "2D only", "3D only"]
    traced = {r["method"]: r for r in first["error_against_time"] if "traced" in r}
    assert traced["4 rays"]["mse_2d"] < traced["1 rays"]["mse_2d"]
    front = {row["method"]: row for row in first["error_against_time"]}
    assert front["run run"]["mse_2d"] == front[OURS]["mse_2d"]
    text = (tmp_path / "out" / "report.md").read_text()
    assert all(name in text for name in (*names, "rays of equal MSE"))
    scene, pixels, *found = re.search(r"\| (shape_.*) \|", text)[1].split(" | ")
    assert [scene] == first["names"]
    assert 48**2 / 4 < int(pixels) == first["rows"][0]["pixels"] < 48**2
    relative = [row["relative_mse_2d"] for row in first["results"]]
    assert [float(word) for word in found] == pytest.approx(relative, rel=1e-3)
    errors = {row["method"]: row["mse_2d"] for row in first["results"]}
    counted, _ = first["light_counted"]
    assert counted["mse_2d"] == front[OURS]["mse_2d"]
    assert 0 < counted["seconds_sampling"] < counted["seconds"]
    assert "| samples s | network s |" in text
    lost = [line for line in first["lost_cells"] if "mse_2d: screen space" in line]
    assert bool(lost) == (errors["screen space"] < errors[OURS])
    assert all(line in text for line in first["lost_cells"])
    assert (tmp_path / "out" / "ablation.png").stat().st_size > 1000
    kept = next((tmp_path / "out" / "references").iterdir())
    before = kept.stat().st_mtime_ns
    again = experiment.main(replace(options, beside=(), scales=()))
    assert kept.stat().st_mtime_ns == before
    for one, two in zip(first["results"], again["results"], strict=True):
        assert one["mse_2d"] == two["mse_2d"]
    stored = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert stored["lost_cells"] == again["lost_cells"]

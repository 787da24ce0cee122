"""Trained networks that come with the package: they load, and are the ones measured."""

import json
import shutil
from contextlib import nullcontext
from functools import cache
from pathlib import Path

import jax
import numpy as np
import pytest
import tiny

from experiments import export
from ginn_jax import checkpoint, fit, presets, pretrained, report, run_record, sequences
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model

MANIFEST = pretrained.load_manifest()
FULL = ["ao", "gi", "sss"]
FINE = ["ao_fine", "sss_fine"]
NETWORKS = [name + part for name in FULL for part in ("", "_only_2d", "_only_3d")]
NETWORKS += FINE


@cache
def shipped(name):
    return pretrained.load_pretrained(name)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A folder with the untrained tiny network under the name "ao"."""
    run, folder = (tmp_path_factory.mktemp(n) for n in ("run", "weights"))
    state = tiny.fresh_state()
    record = {"objects": [], "data": {}, "start": "runs/first"}
    run_record.save_run(run, tiny.CONFIG, tiny.ROOM, record)
    manager = checkpoint.open_manager(run, fresh=True)
    checkpoint.save_state(manager, state)
    manager.close()
    fit.save_losses(run, [0.0])
    pooled = {"relative_mse_3d": 0.5, "median_relative_mse_3d": 0.5}
    pooled |= {"equal_rays": 1.0, "clouds": 1}
    metrics = {"unseen shapes": pooled, "unseen shapes, each": [pooled]}
    metrics |= {"steps": 0, "environment": {"packages": {}}}
    (run / "metrics.json").write_text(json.dumps(metrics))
    pretrained.export(run, "ao", {"command": "none"}, folder)
    return folder, state, run


def test_weights_come_back_bit_for_bit(exported):
    folder, state, _ = exported
    config, limits, weights = pretrained.load_pretrained("ao", folder)
    assert (config, dict(limits.sizes)) == (tiny.CONFIG, dict(tiny.LIMITS.sizes))
    assert tiny.identical(weights, jax.device_get(state.variables))
    errors = pretrained.load_manifest(folder)["ao"]["errors"]
    assert list(errors) == ["unseen shapes"]
    assert errors["unseen shapes"]["relative_mse_3d"] == 0.5


@pytest.mark.parametrize("effect", ["gi", "sss"])
def test_a_run_of_another_effect_is_refused(exported, effect):
    _, _, run = exported
    config, _, _ = pretrained.load_network("ao", str(run))
    assert config == tiny.CONFIG
    with pytest.raises(InputError, match=f"is no network of {effect}: name"):
        pretrained.load_network(effect, str(run))


@pytest.mark.parametrize("name", ["gi", "sss_only_2d", "nothing"])
def test_a_run_is_not_exported_under_another_effect(exported, tmp_path, name):
    _, _, run = exported
    with pytest.raises(InputError, match=f"^--name is {name}: let it begin"):
        export.main(export.Options(run, name, "none", tmp_path))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("effect", ["gi", "sss"])
@pytest.mark.parametrize("preset", presets.ILLUMINATION)
def test_every_preset_tells_its_effect(effect, preset):
    every = {"gi": presets.ILLUMINATION, "sss": presets.SCATTERING}
    assert presets.effect_of(every[effect][preset]) == effect


def test_errors_are_named_by_their_set(exported, tmp_path):
    """Of the paper's split, the first set is not of shapes alone."""
    _, _, run = exported
    shutil.copytree(run, tmp_path / "run")
    path = tmp_path / "run" / "metrics.json"
    metrics = json.loads(path.read_text())
    first = metrics.pop("unseen shapes")
    sets = {f"unseen {name}": first for name in ("validation", "test")}
    path.write_text(json.dumps(first | metrics | sets))
    pretrained.export(tmp_path / "run", "ao", {}, tmp_path)
    assert set(pretrained.load_manifest(tmp_path)["ao"]["errors"]) == set(sets)


@pytest.mark.parametrize("content", ["no JSON", "{}", '{"unseen shapes": {}}'])
def test_a_run_of_damaged_records_is_not_exported(exported, tmp_path, content):
    _, _, run = exported
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "metrics.json").write_text(content)
    with pytest.raises(InputError, match=r"metrics.json is damaged: [^\n]*finish"):
        pretrained.export(tmp_path / "run", "ao", {}, tmp_path)
    assert not (tmp_path / "ao.npz").exists()


@pytest.mark.parametrize("begun", [None, "runs/first"])
def test_what_training_began_with_is_told(exported, begun):
    folder, *_ = exported
    assert pretrained.load_manifest(folder)["ao"]["start"] == "runs/first"
    options = {"batch": 2, "seed": 1, "start": begun}
    told = report.steps_taken({"steps": 30, "options": options})
    assert told.startswith("30 steps of 2 clouds")
    assert ("on the weights of runs/first" in told) == (begun == "runs/first")


def test_unknown_names_and_damaged_files_are_told(exported, tmp_path):
    folder, *_ = exported
    with pytest.raises(InputError, match=r"'water'.*there are ao"):
        pretrained.load_pretrained("water", folder)
    with pytest.raises(InputError, match="none, so install the package"):
        pretrained.load_pretrained("ao", tmp_path)
    manifest = (folder / pretrained.MANIFEST).read_text()
    (tmp_path / pretrained.MANIFEST).write_text(manifest)
    with pytest.raises(InputError, match="no such"):
        pretrained.load_pretrained("ao", tmp_path)
    whole = (folder / "ao.npz").read_bytes()
    (tmp_path / "ao.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match="damaged"):
        pretrained.load_pretrained("ao", tmp_path)
    (tmp_path / pretrained.MANIFEST).write_text(manifest[:-20])
    with pytest.raises(InputError, match="damaged"):
        pretrained.load_pretrained("ao", tmp_path)


def test_weights_of_another_network_or_not_finite_are_refused(exported, tmp_path):
    folder, *_ = exported
    with np.load(folder / "ao.npz") as file:
        arrays = dict(file)
    name = next(n for n in arrays if n != "origin")
    (tmp_path / pretrained.MANIFEST).write_bytes(
        (folder / pretrained.MANIFEST).read_bytes()
    )
    np.savez(tmp_path / "ao.npz", **(arrays | {name: arrays[name][:-1]}))
    with pytest.raises(InputError, match="another network"):
        pretrained.load_pretrained("ao", tmp_path)
    np.savez(tmp_path / "ao.npz", **(arrays | {name: np.nan * arrays[name]}))
    with pytest.raises(InputError, match="not finite"):
        pretrained.load_pretrained("ao", tmp_path)


def test_training_starts_from_a_run_or_from_the_package(exported):
    _, state, run = exported
    found = pretrained.starting_weights(str(run), tiny.CONFIG)
    assert tiny.identical(found, jax.device_get(state.variables))
    config, _, weights = shipped("ao_only_2d")
    assert tiny.identical(pretrained.starting_weights("ao_only_2d", config), weights)
    with pytest.raises(InputError, match="other layers"):
        pretrained.starting_weights(str(run), config)
    with pytest.raises(InputError, match=r"'a0'.*there are ao"):
        pretrained.starting_weights("a0", config)


def test_manifest_has_every_network_and_no_other():
    assert sorted(MANIFEST) == sorted(NETWORKS)


@pytest.mark.parametrize("name", NETWORKS)
def test_every_network_loads_and_is_small(name):
    config, _, weights = shipped(name)
    assert config.steps == MANIFEST[name]["steps"]
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    assert (pretrained.FOLDER / f"{name}.npz").stat().st_size < 2e6


@pytest.fixture(scope="module")
def scenes_once():
    """The scene of a finer network is that of the other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(export, "lit_cloud", cache(export.lit_cloud))
        yield


@pytest.mark.usefixtures("scenes_once")
@pytest.mark.parametrize("name", FULL + FINE)
def test_the_error_on_the_fixed_scene_is_the_stored_one(name):
    """One of them in the code that users' calls compile to."""
    config, limits, weights = shipped(name)
    effect = presets.effect_of(config.network)
    assert effect == name.split("_")[0]
    given = effect, config.network, limits
    with nullcontext() if name == "ao" else tiny.cheap_compiling():
        error = export.fixed_scene_error(*given, Model(weights, jax.random.key(0)))
    stored = MANIFEST[name]["fixed_scene_relative_mse_3d"]
    assert error == pytest.approx(stored, rel=0.05)


def test_a_folder_does_not_stand_in_for_a_network_of_the_package(tmp_path, monkeypatch):
    """As `--out gi` leaves one: who wants that says so."""
    (tmp_path / "gi").mkdir()
    monkeypatch.chdir(tmp_path)
    assert pretrained.run_folder("gi") is None
    assert pretrained.run_folder("./gi") == Path("gi")
    config, _, _ = pretrained.load_network("gi", None)
    assert presets.effect_of(config.network) == "gi"
    with pytest.raises(InputError, match="gi holds no run"):
        pretrained.load_network("gi", "./gi")


def test_folders_may_be_strings(exported, tmp_path):
    _, state, run = exported
    pretrained.export(str(run), "sea", {}, str(tmp_path))
    for found in (
        checkpoint.load_weights(str(run)),
        pretrained.load_pretrained("sea", str(tmp_path)),
    ):
        assert tiny.identical(jax.device_get(found[2]), jax.device_get(state.variables))
    assert sequences.find_animations(str(tmp_path / "a.npz")) == [tmp_path / "a.npz"]

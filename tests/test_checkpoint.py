import json
import shutil
import time
from dataclasses import replace

import jax
import numpy as np
import pytest
import tiny
from rich.console import Console

from ginn_jax import checkpoint, experiment, run_record
from ginn_jax.errors import InputError
from ginn_jax.limits import Limits
from ginn_jax.room import Room

CONFIG = replace(tiny.CONFIG, network=tiny.ONE_LEVEL)
LIMITS = tiny.ONE_LEVEL_LIMITS
ROOM = Room(Limits(tuple((name, size // 2) for name, size in LIMITS.sizes)), LIMITS)
EXTRA = {"clouds": 12, "rays": 64}
RAISED = {"level_0.edges": 4096}
SECONDS = {"compile": 31.5, "train": 280.0}


pytestmark = pytest.mark.usefixtures("cheap_compiling")


def after(state, steps):
    for _ in range(steps):
        state, _ = tiny.step(state, tiny.batch(), CONFIG, LIMITS)
    return state


def save(folder, *states):
    """Save states in turn, and wait until they are written."""
    manager = checkpoint.open_manager(folder)
    for state in states:
        checkpoint.save_state(manager, state)
    manager.close()


def restore(folder):
    manager = checkpoint.open_manager(folder)
    try:
        return checkpoint.restore_state(manager, tiny.fresh_state(CONFIG, LIMITS))
    finally:
        manager.close()


@pytest.fixture(scope="module")
def third():
    """The state after three steps, as NumPy."""
    return jax.tree.map(np.array, after(tiny.fresh_state(CONFIG, LIMITS), 3))


@pytest.fixture(scope="module")
def saved(third, tmp_path_factory):
    """A folder with that state."""
    folder = tmp_path_factory.mktemp("run")
    save(folder, third)
    return folder


def test_resumed_run_equals_an_unbroken_one(third, saved):
    resumed = restore(saved)
    assert tiny.identical(jax.tree.map(np.array, resumed), third)
    like = tiny.fresh_state(CONFIG, LIMITS)
    assert jax.tree.map(lambda a: a.sharding, resumed) == jax.tree.map(
        lambda a: a.sharding, like
    )
    resumed, unbroken = after(resumed, 3), after(tiny.fresh_state(CONFIG, LIMITS), 6)
    assert tiny.identical(resumed, unbroken)
    assert resumed.step == 6


def test_no_checkpoint_is_none(tmp_path):
    assert restore(tmp_path) is None


def test_newest_two_are_kept_and_the_newest_restored(third, tmp_path):
    states = [third._replace(step=np.int32(s)) for s in (5, 6, 7, 7)]
    save(tmp_path, *states)
    manager = checkpoint.open_manager(tmp_path)
    assert list(manager.all_steps()) == [6, 7]
    manager.close()
    assert restore(tmp_path).step == 7


def test_reading_a_run_leaves_what_is_being_written(third, recorded):
    """Whoever writes is not done: what looks left over may be half of a checkpoint."""
    save(recorded, third)
    half = recorded / "checkpoints" / "9.orbax-checkpoint-tmp"
    half.mkdir()
    (half / "part").write_text("half")
    _, _, variables = checkpoint.load_weights(recorded)
    assert tiny.identical(jax.tree.map(np.array, variables), third.variables)
    time.sleep(0.5)  # orbax cleans up beside whatever else it does
    assert (half / "part").read_text() == "half"


def restore_or_reason(folder):
    """What is restored and None, or None and why not."""
    try:
        return restore(folder), None
    except InputError as error:
        return None, str(error)


def test_damaged_checkpoint_is_refused(third, saved, tmp_path):
    """Each file in turn cut to half: one line naming the folder, or no harm done."""
    files = [p.relative_to(saved) for p in saved.rglob("*") if p.is_file()]
    refused = 0
    for number, file in enumerate(sorted(files)):
        folder = tmp_path / str(number)
        shutil.copytree(saved, folder)
        whole = (folder / file).read_bytes()
        (folder / file).write_bytes(whole[: len(whole) // 2])
        found, reason = restore_or_reason(folder)
        if reason is None:
            assert tiny.identical(jax.tree.map(np.array, found), third), file
        else:
            refused += 1
            assert str(folder / "checkpoints" / "3") in reason
            assert "\n" not in reason
    assert refused >= 2


def test_damaged_notes_on_a_checkpoint_are_refused(saved, tmp_path):
    shutil.copytree(saved, tmp_path / "run")
    [notes] = (tmp_path / "run").rglob("*_CHECKPOINT_METADATA")
    notes.write_text('{"unknown": 1, "custom_metadata": {"known": 2}}')
    _, reason = restore_or_reason(tmp_path / "run")
    assert reason is not None
    assert str(tmp_path / "run" / "checkpoints") in reason


def test_checkpoint_of_another_network_is_refused(third, tmp_path):
    encoder = third.variables["encoder"]
    less = {k: v for k, v in encoder["params"].items() if k != "conv_0"}
    other = third.variables | {"encoder": {"params": less}}
    save(tmp_path, third._replace(variables=other))
    with pytest.raises(InputError, match=r"^checkpoint [^\n]*checkpoints/3[^\n]*$"):
        restore(tmp_path)


@pytest.fixture
def recorded(tmp_path):
    """A folder with the record of a run."""
    for name in run_record.RESULTS:
        (tmp_path / name).write_text("of earlier weights")
    run_record.save_run(tmp_path, CONFIG, ROOM, EXTRA, SECONDS, RAISED)
    return tmp_path


def test_record_comes_back(recorded):
    room, seconds, raised = run_record.load_run(recorded, CONFIG, EXTRA)
    assert dict(room.usual.sizes) == dict(ROOM.usual.sizes)
    assert dict(room.most.sizes) == dict(LIMITS.sizes)
    assert (seconds, raised) == (SECONDS, RAISED)
    assert [p.name for p in recorded.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    "change",
    [
        {"steps": 7},
        {"batch_size": 4},
        {"points": 999},
        {"learning_rate": 0.01},
        {"schedule": "paper"},
        {"seed": 1},
        {"network": replace(tiny.ONE_LEVEL, hidden=8)},
        {"network": tiny.NETWORK},
    ],
)
def test_other_configuration_is_refused(recorded, change):
    [name] = change
    with pytest.raises(InputError, match=rf"^[^\n]*run\.json[^\n]* {name}\b[^\n]*$"):
        run_record.load_run(recorded, replace(CONFIG, **change), EXTRA)


@pytest.mark.parametrize("extra", [{"clouds": 13, "rays": 64}, EXTRA | {"new": 1}])
def test_other_data_is_refused(recorded, extra):
    name = "clouds" if "new" not in extra else "new"
    with pytest.raises(InputError, match=rf"another {name}\b"):
        run_record.load_run(recorded, CONFIG, extra)


def test_no_record_is_refused(tmp_path):
    with pytest.raises(InputError, match="no run to resume"):
        run_record.load_run(tmp_path, CONFIG, EXTRA)


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "[1, 2]",
        lambda text: "3",
        lambda text: text.replace('"limits"', '"limit"'),
        lambda text: json.dumps(json.loads(text) | {"limits": {"a": None}}),
        lambda text: json.dumps(json.loads(text) | {"training": 3}),
        lambda text: json.dumps(json.loads(text) | {"seconds": {"train": "long"}}),
    ],
)
def test_damaged_record_is_refused(recorded, damage):
    path = recorded / "run.json"
    path.write_text(damage(path.read_text()))
    with pytest.raises(InputError, match=r"^[^\n]*run\.json[^\n]*$"):
        run_record.load_run(recorded, CONFIG, EXTRA)


def test_a_run_that_is_refused_keeps_its_results(recorded):
    results = [recorded / name for name in run_record.RESULTS]
    for path in results:
        path.write_text("of its weights")
    options = experiment.RunOptions(out=recorded, resume=True)
    clouds = [tiny.sphere_on_plane(CONFIG.points, seed) for seed in range(2)]
    clock = experiment.Clock()
    for config, given in ((CONFIG, []), (replace(CONFIG, steps=1), clouds)):
        with pytest.raises(InputError):
            experiment.train(Console(), config, given, options, EXTRA, clock)
    assert [path.read_text() for path in results] == ["of its weights"] * 2


def test_undecodable_record_is_refused(recorded):
    (recorded / "run.json").write_bytes(b"\xff\xfe\x00{")
    with pytest.raises(InputError, match=r"run\.json is damaged"):
        run_record.load_run(recorded, CONFIG, EXTRA)


def test_weights_of_a_run_come_back(third, saved, tmp_path):
    """With nothing but the folder: the configuration is read as well."""
    shutil.copytree(saved, tmp_path, dirs_exist_ok=True)
    run_record.save_run(tmp_path, CONFIG, ROOM, EXTRA)
    config, limits, variables = checkpoint.load_weights(tmp_path)
    assert config == CONFIG
    assert hash(config) == hash(CONFIG)
    assert dict(limits.sizes) == dict(ROOM.usual.sizes)
    assert tiny.identical(jax.tree.map(np.array, variables), third.variables)
    assert all(len(a.devices()) == 1 for a in jax.tree.leaves(variables))


def test_no_run_has_no_weights(tmp_path):
    with pytest.raises(InputError, match=r"^[^\n]*holds no run: name[^\n]*$"):
        checkpoint.load_weights(tmp_path)


def test_a_run_without_a_checkpoint_has_no_weights(recorded):
    with pytest.raises(InputError, match=r"^[^\n]*no checkpoint yet[^\n]*$"):
        checkpoint.load_weights(recorded)


@pytest.mark.parametrize(
    "change",
    [{"training": 3}, {"limits": {"a": None}}, {"training": {"steps": 3}}],
)
def test_weights_of_a_damaged_record_are_refused(recorded, change):
    path = recorded / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(InputError, match=r"^[^\n]*run\.json is damaged[^\n]*$"):
        checkpoint.load_weights(recorded)


def test_weights_of_another_version_are_refused(recorded):
    path = recorded / "run.json"
    path.write_text(path.read_text().replace('"level_0.words"', '"level_0.buckets"'))
    with pytest.raises(InputError, match=r"another version"):
        checkpoint.load_weights(recorded)


def test_a_run_of_before_two_sizes_of_room_is_of_another_version(recorded):
    path = recorded / "run.json"
    record = json.loads(path.read_text())
    del record["usual"]
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"^[^\n]*another version[^\n]*$"):
        run_record.load_run(recorded, CONFIG, EXTRA)

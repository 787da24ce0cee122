"""Which objects there are, what they are called, and which lights they meet."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from strategies import SEEDS

from ginn_jax.errors import InputError
from ginn_jax.mesh import find_meshes
from ginn_jax.objects import (
    Source,
    file_sources,
    load_object,
    point_lights,
    procedural_lights,
    procedural_sources,
    shape_seed,
    tell_apart,
)
from ginn_jax.pairing import PAPER_SPLIT, pair_up, split_apart, spread

WORD = st.text("ab_0", min_size=1, max_size=3)
PATHS = st.lists(
    st.tuples(st.lists(WORD, max_size=4), WORD, st.sampled_from([".obj", ".ply"])),
    max_size=12,
    unique_by=str,
)
SHAPENET = [
    f"{synset}/{model}/models/model_normalized.obj"
    for synset in ("02691156", "03001627")
    for model in ("1a04e3ea", "1a6ad7a2", "1b171503")
]
SHREC = [f"{i}.obj" for i in (0, 1, 2, 10, 11)]


def boxes(folder, names):
    """A box for each name, each with a side of its own: 1 + its number."""
    for i, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        trimesh.creation.box((1.0, 1.0, 1.0 + i)).export(path)
    return folder


# Names


@pytest.mark.parametrize("names", [SHAPENET, SHREC])
def test_objects_of_a_dataset_load_under_names_of_their_own(tmp_path, names):
    sources = file_sources(find_meshes(boxes(tmp_path, names)))
    assert len({s.name for s in sources}) == len(sources) == len(names)
    assert not any("/" in s.name for s in sources)
    for source in sources:
        place = names.index(str(Path(source.path).relative_to(tmp_path)))
        mesh = load_object(source)
        sides = np.ptp(mesh.vertices[np.unique(mesh.faces[mesh.material == 0])], axis=0)
        np.testing.assert_allclose(sorted(sides)[0], 1 / (1 + place), rtol=1e-5)
        assert (mesh.material == 1).sum() == 2
        assert not (load_object(source, ground=False).material == 1).any()


def test_names_are_those_of_the_datasets():
    names = tell_apart([Path("/data") / name for name in SHREC])
    assert names == ["0", "1", "2", "10", "11"]
    names = tell_apart([Path("/data") / name for name in SHAPENET])
    assert names[0] == "02691156_1a04e3ea_models_model_normalized"
    names = tell_apart([Path("/data") / name for name in SHAPENET[:3]])
    assert names[0] == "1a04e3ea_models_model_normalized"


@pytest.mark.parametrize("root", ["/", "/data", "", "..", "a"])
@given(PATHS)
def test_no_two_paths_have_one_name(root, drawn):
    paths = [Path(root, *folders, stem + ending) for folders, stem, ending in drawn]
    names = tell_apart(paths)
    assert len(set(names)) == len(names) == len(paths)
    assert not any("/" in name for name in names)


def test_folders_of_relative_paths_tell_apart():
    """All of them, so that the names do not depend on the order."""
    paths = [Path("one/thing.obj"), Path("two/thing.obj")]
    assert tell_apart(paths) == ["one_thing", "two_thing"]
    assert tell_apart(paths[::-1]) == ["two_thing", "one_thing"]


def test_same_name_with_other_endings_is_numbered():
    assert tell_apart([Path("/a/b.obj"), Path("/a/b.ply")]) == ["0_b", "1_b"]


# Splits


@given(st.lists(st.integers(), max_size=40, unique=True), st.integers(0, 50))
def test_spread_takes_so_many_at_even_steps(items, count):
    taken = spread(items, count)
    assert len(taken) == min(count, len(items))
    places = [items.index(item) for item in taken]
    steps = np.diff([*places, len(items)]) if places else np.array([1])
    assert places[:1] in ([], [0])
    assert steps.min() > 0
    assert steps.max() - steps.min() <= 1


@given(
    st.lists(st.integers(0, 9), max_size=4), st.integers(0, 5), st.integers(0, 2**31)
)
def test_parts_are_disjoint_and_as_large_as_asked(counts, more, seed):
    items = [f"item {i}" for i in range(sum(counts) + more)]
    parts = split_apart(items, counts, seed)
    assert [len(p) for p in parts] == counts
    together = [item for part in parts for item in part]
    assert len(set(together)) == len(together) == sum(counts)
    assert set(together) <= set(items)
    assert split_apart(items, counts, seed) == parts


def test_seed_decides_the_parts():
    items = list(range(100))
    parts = [tuple(split_apart(items, [60, 40], seed)[0]) for seed in range(5)]
    assert len(set(parts)) == 5
    assert all(p == tuple(sorted(p)) for p in parts)
    # Of many splits, every item is in each part.
    ever = {i for seed in range(30) for i in split_apart(items, [20], seed)[0]}
    assert len(ever) > 95


@given(st.lists(st.integers(1, 9), min_size=1, max_size=4), SEEDS)
def test_too_few_are_refused(counts, seed):
    with pytest.raises(InputError, match=f"needs {sum(counts)}") as caught:
        split_apart(list(range(sum(counts) - 1)), counts, seed)
    assert "\n" not in str(caught.value)


def test_paper_split():
    """Objects and lights of each, 20 k points and 4096 rays."""
    assert PAPER_SPLIT.train == (1000, 20)
    assert PAPER_SPLIT.validation == (200, 5)
    assert PAPER_SPLIT.test == (500, 5)
    assert PAPER_SPLIT.points == 20_000
    assert PAPER_SPLIT.paths == 4096


# Pairs


LIGHTS = {"sky": procedural_lights, "point": point_lights}


@given(
    st.integers(0, 12),
    st.integers(1, 9),
    st.integers(1, 6),
    st.sampled_from(sorted(LIGHTS)),
    st.booleans(),
)
def test_every_object_has_lights_and_every_light_objects(
    count, some, each, kind, files
):
    if files:
        things = file_sources([Path(f"/data/{i}.obj") for i in range(count)])
    else:
        things = procedural_sources(count, 100)
    lights = LIGHTS[kind](some, 50)
    if each > some:
        with pytest.raises(InputError, match=f"^{each} lights .* there are {some}:"):
            pair_up(things, lights, each)
        each = some
    pairs = pair_up(things, lights, each)
    assert len(pairs) == count * each
    assert len({p.name for p in pairs}) == len(pairs)
    assert len({p.seed for p in pairs}) == len(pairs)
    for thing, start in zip(things, range(0, len(pairs), each), strict=True):
        mine = pairs[start : start + each]
        assert len({p.light for p in mine}) == each
        assert {p.path for p in mine} == {thing.path}
        assert all(p.name.startswith(f"{thing.name}__") for p in mine)
    used = [p.light for p in pairs]
    assert len(set(used)) == min(len(pairs), some)
    most = [used.count(light) for light in lights]
    assert max(most) - min(most) <= 1


def test_no_lights_are_refused():
    with pytest.raises(InputError, match="no lights"):
        pair_up(procedural_sources(2, 0), [], 3)


@given(SEEDS, st.integers(1, 5))
def test_shape_has_its_seed_under_any_light(seed, each):
    [alone] = procedural_sources(1, seed)
    pairs = pair_up([alone], procedural_lights(5, 7), each)
    assert shape_seed(alone) == seed
    assert {shape_seed(p) for p in pairs} == {seed}


@given(st.integers(0, 99), st.integers(1, 9), st.integers(1, 9))
def test_other_objects_get_other_seeds_whatever_the_number_of_lights(first, one, other):
    """Their materials are drawn by them: none is trained and tested on."""
    things, lights = procedural_sources(60, first), procedural_lights(9, 0)
    seen, unseen = (
        pair_up(things[:30], lights, one),
        pair_up(things[30:], lights, other),
    )
    assert not {p.seed for p in seen} & {p.seed for p in unseen}


@pytest.mark.parametrize("name", ["chair", "shape_x", "shape_-1", ""])
def test_a_name_that_is_no_shapes_is_refused(name):
    with pytest.raises(InputError, match=r"names no shape: call it .* or give a path"):
        load_object(Source(name, None, 7))


def test_procedural_object_keeps_its_shape_under_any_light():
    [alone] = procedural_sources(1, 5)
    before = load_object(alone)
    for pair in pair_up([alone], procedural_lights(3, 0) + point_lights(1, 0), 4):
        mesh = load_object(pair)
        np.testing.assert_array_equal(mesh.vertices, before.vertices)
        np.testing.assert_array_equal(mesh.faces, before.faces)

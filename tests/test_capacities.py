"""Every capacity, driven to exactly what is needed and to one below.

`test_packets` and `test_hierarchy` do so by one cloud each, whose needs they count by
hand; here clouds are drawn, and host-level calls are given too little.
"""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
from disks import Room, build_level
from hypothesis import Phase, given, settings
from oracles import neighbors
from strategies import ALL_PAIRS, POINTS, SEEDS, UNIT, coordinates, pad

from ginn_jax import block_shading, hierarchy, inference, packets, recipe, train
from ginn_jax.limits import Limits
from ginn_jax.voxels import build_grid

RADIUS = jnp.float32(0.297)  # no distance that clouds are drawn with
KEY = jax.random.key(0)
# Each example compiles anew for each capacity: few, and none to shrink a failure.
FEW = settings(max_examples=3, phases=[Phase.reuse, Phase.generate])
# Enough points for some pairs, or there would be no room to lack.
CROWDED = coordinates(UNIT, 8).map(lambda cloud: pad(cloud, POINTS, garbage=np.nan))


@pytest.fixture(autouse=True)
def _cheap():
    with tiny.cheap_compiling():
        yield


@partial(jax.jit, static_argnames="limit")
def search(cloud, limit):
    grid = build_grid(*cloud, RADIUS)
    return packets.radius_edges(grid, *cloud, RADIUS, limit)


@partial(jax.jit, static_argnames="limit")
def level(cloud, seed, limit):
    grid = build_grid(*cloud, RADIUS)
    key = jax.random.key(seed)
    position, mask = cloud
    ends = position, position, mask
    return build_level(
        grid, *ends, RADIUS, limit, hierarchy.draw_lots(len(ends[0]), key=key)
    )


def room_for(demand, less=None):
    """Capacities of exactly this, at least 1; the one called `less` is one below."""
    wanted = {n: int(v) - (n == less) for n, v in demand._asdict().items()}
    return packets.EdgeLimit(**{n: max(v, 1) for n, v in wanted.items()})


def listed(edges):
    """Pairs in the order given, without padding."""
    real = edges.receiver < POINTS
    return list(
        zip(edges.receiver[real].tolist(), edges.sender[real].tolist(), strict=True)
    )


def check_lower(demand, need, less):
    """Told exactly; what comes before it too, and nothing after it is told too high."""
    assert getattr(demand, less) == getattr(need, less)
    before = need._fields[: need._fields.index(less)]
    assert all(getattr(demand, n) == getattr(need, n) for n in before)
    assert all(d <= n for d, n in zip(demand, need, strict=True))


@FEW
@given(CROWDED)
def test_a_search_wants_what_it_says(cloud):
    roomy = jax.device_get(search(cloud, ALL_PAIRS))
    need, full = roomy.demand, listed(roomy)
    points, rows = cloud.real()
    true = neighbors(points, points, float(RADIUS))
    assert need.edges == len(full) == len(true)
    assert sorted((rows[q], rows[p]) for q, p in true) == sorted(full)
    assert need.candidates >= len({p for _, p in true})
    exact = jax.device_get(search(cloud, room_for(need)))
    assert listed(exact) == full
    assert exact.demand == need
    for name in need._fields:
        if getattr(need, name) > 1:
            short = jax.device_get(search(cloud, room_for(need, name)))
            check_lower(short.demand, need, name)
            assert set(listed(short)) <= set(full)


@FEW
@given(CROWDED, SEEDS)
def test_a_level_wants_what_it_says(cloud, seed):
    build = lambda search, points: jax.device_get(  # noqa: E731
        level(cloud, seed, Room(search, points))
    )
    roomy, need = build(ALL_PAIRS, POINTS)
    kept = roomy.index[roomy.mask].tolist()
    points = int(need.points)
    assert points == len(kept)
    exact, told = build(room_for(need.search), max(points, 1))
    assert exact.index[exact.mask].tolist() == kept
    assert told == need
    for name in need.search._fields:
        if getattr(need.search, name) > 1:
            check_lower(
                build(room_for(need.search, name), POINTS)[1].search, need.search, name
            )
    if points > 1:
        short, told = build(ALL_PAIRS, points - 1)
        assert told == need
        assert short.index[short.mask].tolist() == kept[:-1]


# Host calls


def one_below(demands):
    """Capacities that each lack one."""
    return Limits(tuple((n, max(int(d) - 1, 1)) for n, d in demands.items()))


def counted(monkeypatch, module, name):
    """What each call of a function of that module said that it needed."""
    calls, function = [], getattr(module, name)

    def called(*args, **options):
        result = function(*args, **options)
        calls.append({n: int(np.max(d)) for n, d in result[1].items()})
        return result

    monkeypatch.setattr(module, name, called)
    return calls


def test_host_calls_find_room_and_drop_nothing(in_blocks, monkeypatch, caplog):
    """Every capacity lacks one: the result is that with room, at the second attempt."""
    network, roomy = tiny.ONE_LEVEL, tiny.ONE_LEVEL_LIMITS
    config = recipe.Training(network, 1, batch_size=1, points=64, queries=32)
    variables = train.init_state(config).variables
    cloud = tiny.sphere_on_plane(300, 0)
    ends = cloud.position, cloud.normal
    deep, flat = (
        counted(monkeypatch, inference, "encode_whole"),
        counted(monkeypatch, block_shading, "shade_turn"),
    )

    def run(limits):
        encoded, found = inference.encode_cloud(
            network, limits, variables, *ends, key=KEY
        )
        values, found = inference.shade_points(
            network, found, variables, encoded, *ends
        )
        return values, found

    expected, _ = run(roomy)
    assert not caplog.records
    need = deep[-1] | flat[-1]
    assert (len(deep), len(flat)) == (1, 1)
    values, found = run(one_below(need))
    # Other capacities, other tiles: sums in another order.
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)
    assert deep[-1] | flat[-1] == need
    assert all(found.of(name) >= n for name, n in need.items())
    assert len(deep) == 1 + 2
    assert len(flat) == 1 + 2
    said = [record.getMessage() for record in caplog.records]
    assert len(said) == 2, "one line for each call"
    names = [set(re.findall(r"(\S+) \d+ to \d+", line)) for line in said]
    assert names[0] | names[1] == set(need)
    again = len(deep), len(flat)
    run(found)
    assert (len(deep), len(flat)) == (again[0] + 1, again[1] + 1)


def test_one_stage_without_room_does_not_swell_the_others(monkeypatch, in_blocks):
    """A Poisson disk that misses edges keeps points in crowds, with edges in crowds."""
    calls = counted(monkeypatch, inference, "encode_whole")
    network, roomy = tiny.ONE_LEVEL, dict(tiny.ONE_LEVEL_LIMITS.sizes)
    config = recipe.Training(network, 1, batch_size=1, points=64, queries=32)
    variables = train.init_state(config).variables
    cloud = tiny.sphere_on_plane(2000, 0)
    ends = cloud.position, cloud.normal
    roomy |= {"level_0.edges": 1 << 18, "level_0.points": 2048}

    def needs(limits):
        given = network, Limits(tuple(limits.items())), variables, *ends
        return dict(inference.encode_cloud(*given, key=KEY)[1].sizes)

    assert needs(roomy) == roomy
    need = calls[0]
    wanted = needs(roomy | need | {"level_0.edges": 64})
    assert calls[1]["conv_0.edges"] > 2 * need["conv_0.edges"]
    assert all(need[n] <= wanted[n] <= 1.4 * need[n] + 64 for n in need)
    assert len(calls) == 3

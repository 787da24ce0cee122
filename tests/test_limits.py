"""Limits of a network on a cloud: every one in turn too small, measured, raised."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_sphere import (
    CLOUD,
    QUERIES,
    SHALLOW,
    as_jax,
    as_numpy,
    demands_of,
    generous,
)

from ginn_jax import limits as lm
from ginn_jax import searches as se
from ginn_jax.presets import PRESETS

pytestmark = pytest.mark.usefixtures("cheap_compiling")


@pytest.fixture(scope="module")
def shallow():
    demands = as_numpy(demands_of(SHALLOW, generous(SHALLOW), "", CLOUD, QUERIES))
    assert lm.fits(generous(SHALLOW), as_jax(demands))
    return demands


@pytest.mark.parametrize(
    "names",
    [
        ("level_0.candidates",),
        ("level_0.edges",),
        ("level_0.points",),
        ("conv_0.columns", "query.columns"),
        ("level_0.words",),
        ("conv_0.edges", "query.edges"),
    ],
)
def test_limits_that_are_too_small_are_named(shallow, names):
    sizes = dict(generous(SHALLOW).sizes)
    limits = lm.Limits(tuple((sizes | {n: int(shallow[n]) - 1 for n in names}).items()))
    # Level 0 is the first: a shortage there leaves the others a lower bound.
    stages = "level_0" if names[0].startswith("level_0") else ""
    demands = demands_of(SHALLOW, limits, stages, CLOUD, QUERIES)
    assert not lm.fits(limits, demands)
    assert lm.exceeded(limits, demands) == {name: shallow[name] for name in names}


def test_no_capacity_is_nothing():
    """Arrays of no rows cannot be gathered from, though nothing be needed."""
    assert lm.round_up(0) == lm.round_up(1) > 0


@pytest.mark.parametrize("start", [100, 1 << 19])
@pytest.mark.parametrize(
    "sizes", [(700, 1000), (1000, 700), (5, 4000), (700,) * 10 + (2000,)]
)
def test_measured_limits_fit(start, sizes):
    """From limits that are too small, and from generous ones."""
    tried = []

    def probe(limits, i):
        tried.append((i, limits))
        return as_jax(demands_by_hand(sizes[i], limits))

    first = se.uniform_limits(SHALLOW, start)
    limits = lm.measure_limits(first, probe, len(sizes), slack=1.0)
    assert tried[0] == (0, first)
    if start > 100:
        shapes = {limits for _, limits in tried}
        assert len(shapes) == (1 if len(sizes) <= lm.FEW else 2)
    for i in range(len(sizes)):
        assert lm.exceeded(limits, probe(limits, i)) == {}


def test_what_an_overflow_garbles_is_not_made_room_for():
    need = {"a.edges": 5000, "a.points": 90, "b.edges": 300}
    garbled = need | {"a.points": 10**6, "b.edges": 10**9}
    tried = []

    def probe(limits, _):
        tried.append(limits)
        return as_jax(need if limits.of("a.edges") >= 5000 else garbled)

    first = lm.Limits((("a.edges", 100), ("a.points", 50), ("b.edges", 200)))
    found = lm.measure_limits(first, probe, 1, slack=1.0)
    assert lm.exceeded(found, as_jax(need)) == {}
    assert [tried[-1].of(n) < 3 * need[n] for n in need] == [True] * 3


def test_searches_on_whole_levels_are_made_room_for_at_once():
    """Each time is a compilation."""
    first = se.uniform_limits(SHALLOW, 100)
    whole = [n for n, _ in first.sizes if n.startswith("level_")]
    tried = []

    def probe(limits, _):
        tried.append(limits)
        return as_jax({n: 90 if n in whole else 5000 for n, _ in limits.sizes})

    first = lm.Limits(tuple((n, max(size, 100)) for n, size in first.sizes))
    found = lm.measure_limits(first, probe, 1, slack=1.0)
    assert {found.of(n) >= 5000 for n, _ in first.sizes if n not in whole} == {True}
    assert len(tried) == 2


def test_limits_are_named_in_the_order_of_the_pipeline(shallow):
    """What lacks room changes nothing of what comes before."""
    name = "level_0.edges"
    sizes = dict(generous(SHALLOW).sizes) | {name: int(shallow[name]) // 2}
    short = lm.Limits(tuple(sizes.items()))
    found = as_numpy(demands_of(SHALLOW, short, "", CLOUD, QUERIES))
    order = se.limit_names(SHALLOW)
    changed = [order.index(n) for n in order if found[n] != shallow[n]]
    assert changed
    assert min(changed) > order.index(name)


def demands_by_hand(size, limits):
    """Demands that, as real ones, are known only as far as limits reach."""
    demands = {name: size + i for i, name in enumerate(dict(limits.sizes))}
    for name in demands:
        if name.endswith("edges"):
            candidates = name.replace("edges", "candidates")
            demands[name] = min(demands[name], limits.of(candidates))
    return demands


def test_raised_limits_hold_the_demands_and_leave_the_rest():
    limits = lm.Limits((("a", 100), ("b", 1000), ("c", 7)))
    raised = lm.raise_limits(limits, {"a": 300, "b": 10}, 1.5)
    assert raised.of("a") >= 450
    assert (raised.of("b"), raised.of("c")) == (1000, 7)
    assert hash(raised) != hash(limits)


@given(st.integers(0, 10**8))
def test_rounded_capacities_hold_their_count(count):
    size = lm.round_up(count)
    assert count <= size <= max(count * 9 / 8, count + 64)


def test_presets_name_each_limit_once():
    for config in PRESETS.values():
        names = se.limit_names(config)
        assert len(set(names)) == len(names)
        assert se.uniform_limits(config, 5).of(names[-1]) == 5


NEEDS = st.dictionaries(
    st.sampled_from(["a", "b", "c"]), st.integers(0, 10**6), min_size=1
)


@given(NEEDS, st.integers(0, 10**7), st.integers(0, 10**7))
def test_fitted_limits_hold_what_was_needed_and_stay(needs, spare, other):
    ample = lm.Limits((*((n, need + spare) for n, need in needs.items()), ("q", other)))
    found = lm.fitted(ample, [as_jax(needs)])
    assert lm.exceeded(found, as_jax(needs)) == {}
    assert all(size <= ample.of(name) for name, size in found.sizes)
    assert found.of("q") == other
    assert lm.fitted(found, [as_jax(needs)]) == found


@given(NEEDS, st.floats(1.0, 20.0))
def test_limits_are_fitted_only_where_they_are_loose(needs, slack):
    ample = lm.limits_for(needs, slack)
    found = lm.fitted(ample, [as_jax(needs)])
    if slack <= lm.LOOSE * lm.SLACK:
        assert found == ample
    if slack > 2 * lm.LOOSE * lm.SLACK and max(needs.values()) > 100:
        assert sum(dict(found.sizes).values()) < sum(dict(ample.sizes).values())


@given(NEEDS, NEEDS)
def test_the_largest_limits_hold_what_any_does(one, other):
    names = {"a": 0, "b": 0, "c": 0}
    limits = [lm.Limits(tuple((names | sizes).items())) for sizes in (one, other)]
    both = lm.largest(*limits)
    for needs in (one, other):
        assert lm.exceeded(both, as_jax(needs)) == {}
    assert all(size in (limits[0].of(n), limits[1].of(n)) for n, size in both.sizes)


def test_what_is_used_often_is_made_in_room_that_fits():
    tried = []

    def attempt(limits):
        tried.append(limits)
        return limits.of("a"), [as_jax({"a": 1000})]

    loose = lm.Limits((("a", 10_000),))
    made, same, demands = lm.with_room(loose, attempt)
    assert (made, same) == (10_000, loose)
    fit = lm.fitted(same, demands)
    assert 1000 <= fit.of("a") < 1500
    assert lm.in_fitting_room(loose, attempt, lambda: loose) == (fit.of("a"), fit)
    assert tried[1:] == [loose, fit]
    assert lm.in_fitting_room(fit, attempt, lambda: fit) == (fit.of("a"), fit)
    assert tried[3:] == [fit]

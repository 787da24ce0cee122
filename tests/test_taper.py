"""Receptive fields that taper: their pairs, their weights, and that areas stay."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import oracles
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from small_sphere import CLOUD, NETWORKS, QUERIES, as_numpy, generous, jitted

from ginn_jax import receptive_field as rf
from ginn_jax.errors import InputError

pytestmark = pytest.mark.usefixtures("cheap_compiling")

TAPER = 0.5
TAPERS = st.sampled_from([0.1, 0.25, 1.0])
OFFSETS = hnp.arrays(
    np.float32, (7, 24), elements=st.floats(-1.5, 1.5, width=32), fill=st.nothing()
)


@given(OFFSETS, TAPERS)
def test_window_falls_from_one_to_nothing_across_the_border(inputs, taper):
    """Only the first three rows are the offset."""
    found = np.asarray(rf.window(jnp.asarray(inputs), taper))
    for column, value in zip(inputs.astype(np.float64).T, found, strict=True):
        squared = oracles.distance(column[:3], np.zeros(3)) ** 2
        if squared <= 1 - taper:
            assert value == 1
        elif squared >= 1 + taper:
            assert value == pytest.approx(0, abs=1e-5)
        else:
            share = (1 + taper - squared) / (2 * taper)
            assert value == pytest.approx(share, abs=1e-5)


@given(TAPERS)
def test_window_adds_up_to_the_sharp_disk(taper):
    steps = np.linspace(-1.5, 1.5, 601, dtype=np.float32)
    x, y = (a.reshape(-1) for a in np.meshgrid(steps, steps))
    found = np.asarray(rf.window(jnp.stack([x, 0 * x, y]), taper), np.float64)
    assert found.sum() * 0.005**2 == pytest.approx(np.pi, rel=1e-3)


@pytest.fixture(scope="module", params=NETWORKS)
def built(request):
    network = replace(NETWORKS[request.param], taper=TAPER)
    return network, *as_numpy(jitted(network, generous(network), CLOUD, QUERIES))


@pytest.fixture(scope="module")
def sharp():
    network = NETWORKS["surface"]
    return as_numpy(jitted(network, generous(network), CLOUD, QUERIES))[:2]


def real_rows(points):
    return np.asarray(points.position, np.float64)[points.mask]


def test_fields_of_f_3d_reach_further_that_of_f_2d_does_not(built):
    network, geometry, query_field, _ = built
    reach = {c.name: c.radius * np.sqrt(1 + TAPER) for c in network.encoder}
    reach[network.query.name] = network.query.radius
    for conv in (*network.encoder, network.query):
        asked = conv is network.query
        field = query_field if asked else geometry.fields[conv.name]
        receivers = QUERIES if asked else geometry.levels[conv.target]
        places = np.flatnonzero(receivers.mask)
        ends = real_rows(geometry.levels[conv.source]), receivers.position[places]
        expected = oracles.neighbors(*ends, np.float32(reach[conv.name]))
        real = field.receiver < len(receivers.mask)
        found = zip(field.receiver[real], field.sender[real], strict=True)
        assert set(found) == {(places[q], p) for q, p in expected}


def test_weights_are_those_of_areas_in_the_window(built, sharp):
    """But for rounding, areas are what they are without; f_2D's weights are too."""
    network, geometry, query_field, _ = built
    if network.density != "surface":
        pytest.skip("the paper's density has no areas")
    plain, plain_query = sharp
    np.testing.assert_allclose(geometry.area, plain.area, rtol=1e-6)
    np.testing.assert_allclose(query_field.weight, plain_query.weight, rtol=1e-6)
    checked = 0
    for conv in network.encoder:
        if conv.source:
            continue
        field, rows = geometry.fields[conv.name], geometry.levels[conv.target].mask
        real = field.receiver < len(rows)
        x = geometry.levels[conv.target].position[field.receiver[real]]
        y = geometry.levels[0].position[field.sender[real]]
        squared = np.sum((x.astype(np.float64) - y) ** 2, axis=1) / conv.radius**2
        share = np.clip((1 + TAPER - squared) / (2 * TAPER), 0, 1)
        area = plain.area[field.sender[real]].astype(np.float64)
        expected = share * area / (np.pi * conv.radius**2)
        np.testing.assert_allclose(field.weight[real], expected, rtol=1e-3, atol=1e-6)
        assert not field.weight[~real].any()
        checked += ((share > 0) & (share < 1)).sum()
    assert checked > 100


@pytest.mark.parametrize("taper", [-0.1, 1.5, np.nan])
def test_another_taper_is_refused(taper):
    with pytest.raises(InputError, match="taper"):
        replace(NETWORKS["surface"], taper=taper)

"""What packets of queries promise beyond a search's results (`test_neighbors`)."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import neighbors

from ginn_jax import packets as pk
from ginn_jax import voxels as vx
from ginn_jax.candidates import DENSE_PACKET, PACKET

pick = jax.jit(pk.select_bit)
search = jax.jit(pk.radius_edges, static_argnames=("limit", "packet"))
sizes = pytest.mark.parametrize("packet", [PACKET, DENSE_PACKET])
make_grid = jax.jit(vx.build_grid)
pytestmark = pytest.mark.usefixtures("cheap_compiling")

ROOM = pk.EdgeLimit(4096, 1 << 15, 1024, 1 << 15)


@given(st.lists(st.integers(1, 2**32 - 1), min_size=6, max_size=6))
def test_bits_are_selected_by_rank(words):
    places = [[b for b in range(32) if word >> b & 1] for word in words]
    cases = [
        (w, r, b)
        for w, bits in zip(words, places, strict=True)
        for r, b in enumerate(bits)
    ]
    cases += [(1, 0, 0)] * (192 - len(cases))
    word, rank, bit = np.array(cases).T
    found = pick(word.astype(np.uint32), rank.astype(np.int32))
    np.testing.assert_array_equal(found, bit)


@pytest.fixture(scope="module")
def crowd():
    """More candidates to a packet than a word holds, queries in no order."""
    rng = np.random.default_rng(5)
    return rng.random((400, 3)).astype(np.float32), rng.random((150, 3)).astype(
        np.float32
    )


def pairs(points, queries, radius, packet, limit=ROOM):
    grid = make_grid(points, np.ones(len(points), bool), np.float32(radius))
    mask = np.ones(len(queries), bool)
    edges = search(grid, queries, mask, np.float32(radius), limit, packet=packet)
    edges = jax.tree.map(np.asarray, edges)
    real = edges.receiver < len(queries)
    assert (np.diff(edges.receiver) >= 0).all()
    listed = list(
        zip(edges.receiver[real].tolist(), edges.sender[real].tolist(), strict=True)
    )
    assert len(set(listed)) == len(listed)
    return set(listed), edges.demand


@sizes
def test_lists_of_several_words_and_a_last_packet_that_is_not_full(crowd, packet):
    points, queries = crowd
    assert len(queries) % packet
    found, demand = pairs(points, queries, 0.3, packet)
    assert found == set(neighbors(points.astype(float), queries.astype(float), 0.3))
    assert demand.words > 2 * -(-len(queries) // packet)


@sizes
def test_exact_limits_suffice_and_one_less_is_told(crowd, packet):
    points, queries = crowd
    full, demand = pairs(points, queries, 0.3, packet)
    exact = pk.EdgeLimit(*(int(need) for need in demand))
    assert pairs(points, queries, 0.3, packet, exact) == (full, demand)
    for name in demand._fields:
        short = pk.EdgeLimit(
            **{n: int(v) - (n == name) for n, v in demand._asdict().items()}
        )
        found, told = pairs(points, queries, 0.3, packet, short)
        assert found <= full
        assert getattr(told, name) == getattr(demand, name)

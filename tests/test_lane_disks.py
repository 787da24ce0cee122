"""Poisson disks in lanes against sequential dart throwing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from oracles import distance
from strategies import FACES, FAR, UNIT, clouds, coordinates, unit_rows

from ginn_jax import lane_disks
from ginn_jax.renderer import use_drjit

# No distance between points on the tests' lattices, nor is `HOLD` of it.
RADIUS = 0.297
POINTS = clouds().filter(len) | coordinates(UNIT | FACES | FAR, 1, 32)
# Few different ones, on both sides of a quarter and of a half: many tie.
LOTS = st.integers(0, 7).map(lambda k: k << 29)


@st.composite
def darts(draw):
    """Samples, their unit normals, lots and names, and which were kept before."""
    position = draw(POINTS)
    count = len(position)
    normal = unit_rows(draw(hnp.arrays(np.float32, (count, 3), elements=UNIT)))
    lot = draw(hnp.arrays(np.uint32, count, elements=LOTS))
    name = np.array(draw(st.permutations(range(count))))
    return position, normal, lot, name, draw(hnp.arrays(bool, count))


def thrown(position, normal, lot, name, before, sided, moved):
    """Rows kept one by one; None where rounding decides which side two look."""
    position, normal = position.astype(np.float64), normal.astype(np.float64)
    if moved:
        lot = lot >> 1 | np.where(before, 0, 1 << 31).astype(np.uint32)
    kept = []
    for i in sorted(range(len(lot)), key=lambda i: (lot[i], name[i])):
        conflict = False
        for k in kept:
            facing = normal[i] @ normal[k]
            near = RADIUS * (0.6 if moved and before[i] and before[k] else 1)
            if distance(position[i], position[k]) >= near:
                continue
            if sided and abs(facing) < 1e-5:
                return None, lot
            conflict |= not (sided and facing < 0)
        if not conflict:
            kept.append(i)
    return sorted(kept), lot


@pytest.mark.parametrize("few", [1, 1 << 12])
@pytest.mark.parametrize("moved", [False, True])
@pytest.mark.parametrize("sided", [False, True])
@given(drawn=darts())
def test_lanes_keep_what_darts_keep(few, sided, moved, drawn):
    """At once, and in two waves."""
    position, normal, _, name, _ = drawn
    expected, lot = thrown(*drawn, sided, moved)
    if expected is None:
        return
    disk = lane_disks.Disk(RADIUS, sided, moved)
    given = use_drjit(), disk, position, normal, lot, name
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lane_disks, "FEW", few)
        found = lane_disks.sample_disk_in_lanes(*given)
    assert sorted(found) == expected


def test_a_long_chain_of_conflicts_is_settled():
    """Each in turn beats the next: as many rounds as samples."""
    count = 400
    position = np.zeros((count, 3), np.float32)
    position[:, 0] = 0.6 * RADIUS * np.arange(count)
    normal = np.tile(np.float32([0, 1, 0]), (count, 1))
    lot = np.arange(count, dtype=np.uint32)
    disk = lane_disks.Disk(RADIUS, True, False)
    given = position, normal, lot, np.arange(count)
    found = lane_disks.sample_disk_in_lanes(use_drjit(), disk, *given)
    assert sorted(found) == list(range(0, count, 2))

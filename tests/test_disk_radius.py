"""A trained network at other Poisson disk radii."""

import re
from dataclasses import replace

import numpy as np
import pytest
import tiny

from ginn_jax.disk_radius import limits_at, with_disk_radius
from ginn_jax.errors import InputError
from ginn_jax.limits import SLACK, Limits, limits_for
from ginn_jax.presets import compact_network


def test_other_disk_radius_changes_the_finest_level_only():
    other = with_disk_radius(tiny.NETWORK, 0.05)
    assert other == replace(tiny.NETWORK, levels=(0.05, 0.2))


@pytest.mark.parametrize("radius", [0.0, -0.1, 0.16, 0.3, np.nan, np.inf])
def test_unusable_disk_radius_is_refused(radius):
    with pytest.raises(InputError, match=rf"^Poisson radius {re.escape(str(radius))}"):
        with_disk_radius(tiny.NETWORK, radius)


def test_disk_radius_beyond_level_1_is_refused():
    network = replace(tiny.NETWORK, levels=(0.08, 0.1))
    with pytest.raises(InputError, match=r"exceeds level 1's: give one up to 0\.1"):
        with_disk_radius(network, 0.12)


# What the compact network needed of 20,000 samples of a procedural shape, and of 16,384
# pixels, at disk radii .015, .02 and .03.
DEMANDS = {
    "level_0": {
        "columns": (14618, 9675, 6289),
        "candidates": (117501, 134843, 185261),
        "words": (3964, 4517, 6095),
        "edges": (39902, 71618, 163770),
        "points": (6855, 4520, 2304),
    },
    "level_1": {
        "columns": (11626, 10704, 8785),
        "candidates": (44230, 25667, 10565),
        "words": (1493, 872, 365),
        "edges": (48372, 19954, 4730),
        "points": (865, 812, 733),
    },
    "conv_0": {
        "columns": (11626, 10704, 8785),
        "candidates": (44230, 25667, 10565),
        "words": (1493, 872, 365),
        "edges": (103599, 44428, 11764),
    },
    "up_1": {
        "columns": (4315, 3634, 2718),
        "candidates": (8015, 6335, 4428),
        "words": (345, 274, 176),
        "edges": (29415, 18179, 8297),
    },
    "query": {
        "columns": (15520, 15520, 15520),
        "candidates": (53084, 34891, 17623),
        "words": (1912, 1356, 758),
        "edges": (118052, 77320, 38540),
    },
}


@pytest.mark.parametrize(("radius", "column"), [(0.015, 0), (0.02, 1), (0.03, 2)])
def test_limits_at_another_radius_are_those_that_suffice(radius, column):
    """Those of radius .02, with the usual slack, made into those of another."""
    found = {f"{s}.{p}": n for s, parts in DEMANDS.items() for p, n in parts.items()}
    usual = limits_for({name: n[1] for name, n in found.items()}, SLACK)
    scaled = limits_at(compact_network(), usual, radius)
    assert set(dict(scaled.sizes)) == set(found)
    for name, demands in found.items():
        size = scaled.of(name)
        assert demands[column] <= size <= 1.8 * demands[column] + 64, name


@pytest.mark.parametrize("radius", [0.005, 1e-9])
def test_beyond_what_was_measured_limits_stay(radius):
    limits = Limits((("conv_0.edges", 4096), ("level_0.points", 640)))
    network = compact_network()
    farthest = limits_at(network, limits, network.levels[0] / 2)
    assert limits_at(network, limits, radius) == farthest
    assert farthest.of("conv_0.edges") > 4 * 4096


@pytest.mark.parametrize("radius", [0.0, -0.1, np.nan])
def test_no_limits_are_of_no_radius(radius):
    with pytest.raises(InputError, match=rf"^Poisson radius {radius} must be positive"):
        limits_at(compact_network(), Limits(()), radius)


def test_other_limits_do_not_go_with_the_radius():
    limits = Limits((("level_2.edges", 640), ("conv_1.edges", 4096)))
    assert limits_at(compact_network(), limits, 0.01) == limits

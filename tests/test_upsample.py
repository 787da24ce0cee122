"""Shading at a lower rate: what upsampling must keep, and where it must say no."""

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax.upsample import Surface, sample_pixels, upsample

SIZE = 16
lift = jax.jit(upsample)
UP = np.array([0.0, 1, 0], np.float32)


def plane(height=0.0, normal=UP):
    """A level plane seen from above, a pixel .01 wide."""
    x, z = np.meshgrid(*[0.01 * np.arange(SIZE, dtype=np.float32)] * 2)
    position = np.stack([x, np.full_like(x, height), z], axis=-1)
    return Surface(position, np.broadcast_to(normal, position.shape), x >= 0)


def lifted(values, surface, rows, thickness=0.005):
    return jax.tree.map(
        np.asarray, lift(values, rows, rows, surface, np.float32(thickness))
    )


@given(st.integers(1, 300), st.floats(0.01, 1))
def test_samples_are_distinct_pixels_in_order(size, scale):
    samples = sample_pixels(size, scale)
    assert samples[0] >= 0
    assert samples[-1] < size
    assert (np.diff(samples) > 0).all()
    assert len(samples) == max(round(size * scale), 1)


@given(hnp.arrays(np.float32, (8, 8), elements=st.floats(0, 1, width=32)))
def test_values_stay_within_those_around_and_samples_keep_theirs(values):
    rows = sample_pixels(SIZE, 0.5)
    found, known = lifted(values, plane(), rows)
    assert known.all()
    np.testing.assert_allclose(found[np.ix_(rows, rows)], values, atol=1e-6)
    assert found.min() >= values.min() - 1e-6
    assert found.max() <= values.max() + 1e-6


def test_a_linear_ramp_is_interpolated_exactly():
    rows = sample_pixels(SIZE, 0.5)
    ramp = np.add.outer(2.0 * rows, 3.0 * rows).astype(np.float32)
    found, _ = lifted(ramp, plane(), rows)
    inner = np.arange(rows[0], rows[-1] + 1)
    expected = np.add.outer(2.0 * inner, 3.0 * inner)
    np.testing.assert_allclose(found[np.ix_(inner, inner)], expected, rtol=1e-5)


@pytest.mark.parametrize("edge", ["depth", "normal"])
def test_nothing_crosses_an_edge(edge):
    """Two surfaces, one black and one white: no pixel is grey."""
    low, high = plane(), plane(0.2)
    if edge == "normal":
        high = plane(0.0, np.array([1.0, 0, 0], np.float32))
    left = np.arange(SIZE) < 7
    position, normal = (
        np.where(left[None, :, None], a, b)
        for a, b in zip(low[:2], high[:2], strict=True)
    )
    rows = sample_pixels(SIZE, 0.5)
    values = np.where(left[rows], 0.0, 1.0) * np.ones((8, 1))
    surface = Surface(position, normal, low.mask)
    found, known = lifted(values.astype(np.float32), surface, rows)
    expected = np.broadcast_to(np.where(left, 0.0, 1.0), known.shape)
    np.testing.assert_allclose(found[known], expected[known], atol=1e-3)
    assert known.mean() > 0.9


def test_background_neither_darkens_nor_is_given_values():
    """The background of a coarse image holds nonsense: nobody may see it."""
    surface = plane()
    mask = np.arange(SIZE)[None, :] + np.zeros((SIZE, 1)) < 9
    rows = sample_pixels(SIZE, 0.5)
    values = np.where(mask[np.ix_(rows, rows)], 0.5, -1e6).astype(np.float32)
    found, known = lifted(values, surface._replace(mask=mask), rows)
    assert not known[~mask].any()
    np.testing.assert_allclose(found[known], 0.5, rtol=1e-6)
    assert known[mask].all()


def test_a_pixel_of_no_sample_is_left_to_be_shaded():
    """A thin bar between the samples belongs to none of them."""
    surface, raised = plane(), plane(0.3)
    rows = sample_pixels(SIZE, 0.25)
    bar = np.arange(SIZE) == rows[1] + 1
    position = np.where(bar[None, :, None], raised.position, surface.position)
    found, known = lifted(
        np.ones((4, 4), np.float32), surface._replace(position=position), rows
    )
    assert not known[:, bar].any()
    assert known[:, ~bar].all()
    assert (found[:, bar] == 0).all()

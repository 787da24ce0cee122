"""Shading at a lower rate: what upsampling must keep, and where it must say no."""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
import tiny
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from ginn_jax import image
from ginn_jax.shading import Encoded
from ginn_jax.upsample import (
    COARSEST,
    Surface,
    blend,
    blend_between,
    sampled,
    shading_step,
)

pytestmark = pytest.mark.usefixtures("cheap_compiling")

SIZE = 16
UP = np.array([0.0, 1, 0], np.float32)


def plane(height=0.0, normal=UP):
    """A level plane seen from above, a pixel .01 wide."""
    x, z = np.meshgrid(*[0.01 * np.arange(SIZE, dtype=np.float32)] * 2)
    position = np.stack([x, np.full_like(x, height), z], axis=-1)
    return Surface(position, np.broadcast_to(normal, position.shape), x >= 0)


@partial(jax.jit, static_argnums=1)
def lift(values, step, surface, thickness):
    taken = blend_between(step, surface, thickness)
    return blend(values, step, taken), taken.known


def lifted(values, step, surface, thickness=0.005):
    return jax.tree.map(np.asarray, lift(values, step, surface, np.float32(thickness)))


@given(st.integers(1, 300), st.integers(1, COARSEST))
def test_every_so_manieth_pixel_is_shaded(size, step):
    """At least one is, and no pixel is further than a step from one."""
    rows = np.arange(size)[sampled(size, step)]
    assert (np.diff(rows) == step).all()
    assert rows[0] == min(step // 2, size - 1)
    assert size - rows[-1] <= step
    assert shading_step(1 / step) == step


# Few, for each is compiled: sides that are and are not multiples, or below a step.
SIZES = [((7, 6), 2, 1), ((6, 11), 3, 2), ((1, 9), 4, 3), ((2, 2), 5, 1)]


@given(st.sampled_from(SIZES), st.data())
def test_agrees_with_one_pixel_at_a_time(size, data):
    """The definition, with an index for every pixel and in float64."""

    def draw(shape):
        unit = st.floats(0, 1, width=32)
        return data.draw(hnp.arrays(np.float32, shape, elements=unit))

    shape, step, channels = size
    position, mask = draw((*shape, 3)), draw(shape) < 0.8
    normal = draw((*shape, 3)) + np.float32(0.1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    rows, columns = (np.arange(n)[sampled(n, step)] for n in shape)
    values = draw((len(rows), len(columns), channels))
    surface = Surface(position, normal, mask)
    found, known = lifted(values, step, surface, 0.3)
    for place in np.ndindex(shape):
        total, weight = one_pixel(values, rows, columns, surface, place, 0.3)
        assert known[place] == (weight > 0.05) or abs(weight - 0.05) < 1e-5
        wanted = total / weight if known[place] else 0 * total
        np.testing.assert_allclose(found[place], wanted, rtol=1e-4, atol=1e-6)


def one_pixel(values, rows, columns, surface, place, thickness):
    """Weighted values of the samples around a pixel, and the sum of their weights."""
    total, weight = np.zeros(values.shape[2]), 0.0
    here = [np.float64(a[place]) for a in surface]
    for i, share_i in around(rows, place[0]):
        for j, share_j in around(columns, place[1]):
            there = [np.float64(a[rows[i], columns[j]]) for a in surface]
            off = (there[0] - here[0]) @ here[1] / thickness
            like = np.exp(-0.5 * off**2) * max(there[1] @ here[1], 0.0) ** 8
            like *= share_i * share_j * here[2] * there[2]
            total, weight = total + like * values[i, j], weight + like
    return total, weight


def around(samples, pixel):
    """The samples on both sides of a pixel of a row, and how much each counts."""
    after = np.searchsorted(samples, pixel, side="right")
    if after in (0, len(samples)):
        return [(min(after, len(samples) - 1), 1.0)]
    share = (pixel - samples[after - 1]) / (samples[after] - samples[after - 1])
    return [(after - 1, 1 - share), (after, share)]


@given(hnp.arrays(np.float32, (8, 8), elements=st.floats(0, 1, width=32)))
def test_values_stay_within_those_around_and_samples_keep_theirs(values):
    found, known = lifted(values, 2, plane())
    assert known.all()
    np.testing.assert_allclose(found[1::2, 1::2], values, atol=1e-6)
    assert found.min() >= values.min() - 1e-6
    assert found.max() <= values.max() + 1e-6


def test_a_linear_ramp_is_interpolated_exactly():
    rows = np.arange(SIZE)[sampled(SIZE, 2)]
    ramp = np.add.outer(2.0 * rows, 3.0 * rows).astype(np.float32)
    found, _ = lifted(ramp, 2, plane())
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
    rows = np.arange(SIZE)[sampled(SIZE, 2)]
    values = np.where(left[rows], 0.0, 1.0) * np.ones((8, 1))
    surface = Surface(position, normal, low.mask)
    found, known = lifted(values.astype(np.float32), 2, surface)
    expected = np.broadcast_to(np.where(left, 0.0, 1.0), known.shape)
    np.testing.assert_allclose(found[known], expected[known], atol=1e-3)
    assert known.mean() > 0.9


def test_background_neither_darkens_nor_is_given_values():
    """The background of a coarse image holds nonsense: nobody may see it."""
    surface = plane()
    mask = np.arange(SIZE)[None, :] + np.zeros((SIZE, 1)) < 9
    rows = np.arange(SIZE)[sampled(SIZE, 2)]
    values = np.where(mask[np.ix_(rows, rows)], 0.5, -1e6).astype(np.float32)
    found, known = lifted(values, 2, surface._replace(mask=mask))
    assert not known[~mask].any()
    np.testing.assert_allclose(found[known], 0.5, rtol=1e-6)
    assert known[mask].all()


def test_a_pixel_of_no_sample_is_left_to_be_shaded():
    """A thin bar between the samples belongs to none of them."""
    surface, raised = plane(), plane(0.3)
    rows = np.arange(SIZE)[sampled(SIZE, 4)]
    bar = np.arange(SIZE) == rows[1] + 1
    position = np.where(bar[None, :, None], raised.position, surface.position)
    ones = np.ones((4, 4), np.float32)
    found, known = lifted(ones, 4, surface._replace(position=position))
    assert not known[:, bar].any()
    assert known[:, ~bar].all()
    assert (found[:, bar] == 0).all()


def test_colours_are_interpolated_each_by_itself(monkeypatch):
    """A ramp for every colour, one of another slope than the other."""
    slopes = np.array([[0.1, 0.2, 0.3], [0, 0, 0], [0.3, 0.1, -0.2]], np.float32)

    def shade_points(network, limits, variables, encoded, position, *others):
        return 1 + position @ slopes, limits

    tiny.shade_pixels_by(monkeypatch, shade_points)
    encoded = Encoded(None, None, None, None, np.ones(3, np.float32))  # type: ignore
    mask = np.arange(SIZE)[None, :] + np.zeros((SIZE, 1)) != 9
    position, normal, _ = plane()
    for scale in (1 / 2, 1 / 3):
        found, _ = image.shade_image(
            *(tiny.NETWORK, tiny.LIMITS, {}, encoded, position, normal, mask),
            background=7.0,
            resolution_scale=scale,
        )
        assert (found[~mask] == 7).all()
        # A pixel is .01 wide; at borders the nearest sample counts alone.
        wrong = np.abs(found - 1 - position @ slopes)[mask]
        assert wrong.max() < 0.01 * 0.4 / scale
        assert np.median(wrong) < 1e-6


def test_light_stays_with_its_pixels(monkeypatch):
    """Whatever order they are shaded in: light is linear in the place here."""
    slopes = np.float32([[1, 2, 3], [0, 0, 0], [3, 1, 2]])

    def shade_points(network, limits, variables, encoded, place, *more):
        _, material, light, _ = more
        np.testing.assert_allclose(light[..., 0].T, 1 + place @ slopes, rtol=1e-5)
        return material[..., 0].T, limits

    tiny.shade_pixels_by(monkeypatch, shade_points)
    network = replace(tiny.ONE_LEVEL, lights=1, materials=1, asks="all")
    position, normal, _ = plane()
    mask = np.arange(SIZE)[None] + np.zeros((SIZE, 1)) != 9
    light = np.moveaxis(1 + position @ slopes, -1, 0)[..., None]
    codes = Encoded(None, None, None, None, np.ones(3, np.float32))
    given = network, tiny.LIMITS, {}, codes, position, normal, mask
    found, _ = image.shade_image(*given, material=2 * light, light=light)
    expected = 2 + 2 * (position @ slopes)[mask]
    np.testing.assert_allclose(found[mask], expected, rtol=1e-5)

"""Values at points and pixels in blocks, by a network with its initial parameters."""

import jax
import numpy as np
import pytest
import tiny
from hypothesis import given, settings
from hypothesis.extra.numpy import arrays
from hypothesis.strategies import floats

from ginn_jax import block_shading, blocks, image, inference
from ginn_jax.errors import InputError
from ginn_jax.limits import Limits

KEY = jax.random.key(3)
PIXELS = 300


pytestmark = pytest.mark.usefixtures("cheap_compiling", "in_blocks")


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 128)


@pytest.fixture(scope="module")
def variables():
    return tiny.fresh_state().variables


@pytest.fixture(scope="module")
def encoded(variables):
    """Codes of a cloud of 1000 points, with limits that are too generous."""
    return encode(variables, tiny.LIMITS)[0]


def encode(variables, limits):
    points = tiny.sphere_on_plane(1000, 4)
    return inference.encode_cloud(
        tiny.NETWORK, limits, variables, points.position, points.normal, key=KEY
    )


def shade(variables, encoded, points, limits=tiny.LIMITS):
    return inference.shade_points(
        tiny.NETWORK, limits, variables, encoded, points.position, points.normal
    )


def with_limits(**sizes):
    """The usual limits but for some; `__` stands for the dot."""
    changed = {name.replace("__", "."): size for name, size in sizes.items()}
    return Limits(tuple((dict(tiny.LIMITS.sizes) | changed).items()))


@pytest.fixture(scope="module")
def values(variables, encoded):
    """At 300 points, in blocks of 128."""
    points = tiny.sphere_on_plane(PIXELS, 5)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(blocks, "BLOCK", 128)
        found, limits = shade(variables, encoded, points)
        again, same = shade(variables, encoded, points, limits)
    # Of f_2D's room, which is ample, what is left fits and gives the same values.
    changed = {n for n, size in limits.sizes if size != tiny.LIMITS.of(n)}
    assert changed
    assert all(name.startswith("query.") for name in changed)
    assert sum(dict(limits.sizes).values()) < sum(dict(tiny.LIMITS.sizes).values())
    assert same == limits
    np.testing.assert_allclose(again, found, atol=1e-6)
    assert found.shape == (PIXELS,)
    assert found.std() > 1e-3
    return found


def test_values_do_not_depend_on_blocks(variables, encoded, values, monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 512)
    found, _ = shade(variables, encoded, tiny.sphere_on_plane(PIXELS, 5))
    np.testing.assert_allclose(found, values, atol=1e-5)


def test_one_block_leaves_room_for_more(variables, encoded):
    points = jax.tree.map(lambda a: a[:5], tiny.sphere_on_plane(PIXELS, 5))
    assert shade(variables, encoded, points)[1] == tiny.LIMITS


def test_values_stay_with_their_points(variables, encoded, values):
    points = tiny.sphere_on_plane(PIXELS, 5)
    turned = jax.tree.map(lambda column: column[::-1], points)
    found, _ = shade(variables, encoded, turned)
    np.testing.assert_allclose(found[::-1], values, atol=1e-5)


def test_too_small_search_is_raised(variables, encoded, values):
    small = with_limits(query__candidates=64, query__edges=64)
    found, limits = shade(variables, encoded, tiny.sphere_on_plane(PIXELS, 5), small)
    np.testing.assert_allclose(found, values, atol=1e-5)
    before, raised = dict(small.sizes), dict(limits.sizes)
    assert {n for n in raised if raised[n] > before[n]} == {
        "query.candidates",
        "query.edges",
    }
    assert raised["query.edges"] > 64


def test_too_small_geometry_is_raised(variables, encoded, monkeypatch):
    expected = np.array(encoded.points.mask)
    # Raised to the usual limits, which are compiled already.
    monkeypatch.setattr(inference, "SLACK", 1152 / expected.sum())
    found, limits = encode(variables, with_limits(level_0__points=128))
    assert limits == tiny.LIMITS
    mask = np.array(found.points.mask)
    assert mask.sum() == expected.sum() > 200
    np.testing.assert_allclose(
        np.array(found.points.position)[mask],
        np.array(encoded.points.position)[expected],
    )
    np.testing.assert_allclose(
        np.array(found.code.free)[mask],
        np.array(encoded.code.free)[expected],
        atol=1e-5,
    )


def picture(mask):
    """Pixel positions and normals for a mask, not a number outside it."""
    points = tiny.sphere_on_plane(PIXELS, 5)
    position = np.full((*mask.shape, 3), np.nan, np.float32)
    normal = position.copy()
    position[mask], normal[mask] = points.position, points.normal
    return position, normal


def test_only_masked_pixels_are_computed(variables, encoded, values):
    mask = np.random.default_rng(0).permutation(24 * 25).reshape(24, 25) < PIXELS
    result, _ = image.shade_image(
        tiny.NETWORK, tiny.LIMITS, variables, encoded, *picture(mask), mask, 0.25
    )
    assert result.shape == mask.shape
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result[~mask], np.float32(0.25))
    np.testing.assert_allclose(result[mask], np.clip(values, 0, 1), atol=1e-6)


def test_no_pixel_leaves_the_range(variables, encoded):
    """Not even of a network with a last layer a hundred times as loud."""
    loud = jax.tree.map(np.array, variables)
    loud["shader"]["params"]["Dense_1"]["kernel"] *= 100
    mask = np.arange(24 * 25).reshape(24, 25) < PIXELS
    arguments = (tiny.NETWORK, tiny.LIMITS, loud, encoded)
    result, _ = image.shade_image(*arguments, *picture(mask), mask)
    assert result[mask].min() == 0
    assert result[mask].max() == 1


@settings(max_examples=30, deadline=None)
@given(arrays(bool, (7, 9)), arrays(np.float32, (7, 9, 3), elements=floats(-5, 5)))
def test_coherent_pixels_are_those_of_the_mask(mask, position):
    """Each once; what lies outside the mask may be anything."""
    position = np.where(mask[:, :, None], position, np.nan)
    rows = image.coherent_pixels(position, mask, 1.0)
    np.testing.assert_array_equal(np.sort(rows), np.flatnonzero(mask))


def test_coherent_pixels_of_two_sheets_keep_them_apart():
    """A chequered mix of near and far: side by side in the image, not in the list."""
    mask = np.ones((64, 64), bool)
    far = np.indices(mask.shape).sum(0) % 2
    plane = np.stack(np.meshgrid(np.arange(64), np.arange(64)), -1) / 64
    position = np.concatenate([plane, 10.0 * far[..., None]], axis=-1)
    turns = np.diff(far.reshape(-1)[image.coherent_pixels(position, mask, 1.0)])
    assert np.abs(turns).sum() == 1


def test_points_in_order_need_no_sorting(variables, encoded, values):
    points = tiny.sphere_on_plane(PIXELS, 5)
    ends = points.position, points.normal
    arguments = (tiny.NETWORK, tiny.LIMITS, variables, encoded, *ends)
    found, _ = block_shading.shade_blocks(*arguments, coherent=True)
    np.testing.assert_allclose(found, values, atol=1e-6)


def test_number_of_blocks_is_that_of_the_foreground(
    variables, encoded, values, monkeypatch
):
    calls, shade_turn = [], block_shading.shade_turn

    def counted(*arguments):
        calls.append(int(arguments[5][0].mask.sum()))
        return shade_turn(*arguments)

    monkeypatch.setattr(block_shading, "shade_turn", counted)
    mask = np.arange(24 * 25).reshape(24, 25) >= 300
    arguments = (tiny.NETWORK, tiny.LIMITS, variables, encoded)
    image.shade_image(*arguments, *picture(mask), mask)
    assert calls == [128, 128, 44]


def test_empty_picture_is_background(variables, encoded):
    blank = np.full((5, 4, 3), np.nan, np.float32)
    result, limits = image.shade_image(
        tiny.NETWORK,
        tiny.LIMITS,
        variables,
        encoded,
        blank,
        blank,
        np.zeros((5, 4), bool),
    )
    np.testing.assert_array_equal(result, np.ones((5, 4), np.float32))
    assert limits == tiny.LIMITS


def test_points_far_away_are_finite_and_disturb_no_other(variables, encoded, values):
    points = tiny.sphere_on_plane(PIXELS, 5)
    position = points.position.copy()
    position[:50] += np.float32([30, -40, 500])
    position[50] = 1e6
    found, _ = shade(variables, encoded, points._replace(position=position))
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found[51:], values[51:], atol=1e-6)


def test_unusable_cloud_is_refused(variables):
    points = tiny.sphere_on_plane(20, 0)
    arguments = (tiny.NETWORK, tiny.LIMITS, variables)
    nothing = np.zeros((0, 3), np.float32)
    with pytest.raises(InputError, match=r"^the cloud is empty[^\n]*$"):
        inference.encode_cloud(*arguments, nothing, nothing, key=KEY)
    for field in ("position", "normal"):
        for bad in (np.nan, np.inf):
            broken = getattr(points, field).copy()
            broken[7, 1] = bad
            cloud = points._replace(**{field: broken})
            with pytest.raises(InputError, match=r"^[^\n]*non-finite[^\n]*$"):
                inference.encode_cloud(
                    *arguments, cloud.position, cloud.normal, key=KEY
                )


def test_openness_lies_between_0_and_1():
    values = np.array([-3, -0.0, 0.25, 1, 1.5, np.inf], np.float32)
    np.testing.assert_array_equal(image.as_openness(values), [0, 0, 0.25, 1, 1, 1])


def ground_picture():
    """Level ground seen from above, a pixel .02 wide, a strip of it missing."""
    x, z = np.meshgrid(np.linspace(-0.3, 0.3, 32), np.linspace(-0.3, 0.3, 30))
    position = np.stack([x, np.zeros_like(x), z], axis=-1).astype(np.float32)
    normal = np.broadcast_to(np.array([0, 1, 0], np.float32), position.shape)
    return position, normal, np.abs(x - 0.11) > 0.05


def test_a_lower_rate_computes_fewer_pixels(variables, encoded, monkeypatch):
    shaded, shade_blocks = [], block_shading.shade_blocks

    def counted(*arguments, **options):
        shaded.append(len(arguments[4]))
        return shade_blocks(*arguments, **options)

    monkeypatch.setattr(image, "shade_blocks", counted)
    position, normal, mask = ground_picture()
    arguments = (tiny.NETWORK, tiny.LIMITS, variables, encoded, position, normal, mask)
    full, _ = image.shade_image(*arguments)
    half, _ = image.shade_image(*arguments, resolution_scale=0.5)
    assert shaded[0] == mask.sum()
    sampled = tuple(image.sampled(n, 2) for n in mask.shape)
    own = mask[sampled].sum()
    assert own == pytest.approx(mask.sum() / 4, rel=0.1)
    assert 0 <= shaded[1] - own < 0.1 * mask.sum()
    assert len(shaded) == 2
    np.testing.assert_array_equal(half[~mask], full[~mask])
    spread = np.ptp(full[mask])
    assert np.sqrt(np.mean((half - full)[mask] ** 2)) < 0.1 * spread
    np.testing.assert_allclose(half[sampled], full[sampled], atol=1e-5)


@pytest.mark.parametrize("scale", [0.0, -1.0, 1.5, 0.7, 1e-9, np.nan])
def test_unusable_resolution_scale_is_refused(variables, encoded, scale):
    arguments = (tiny.NETWORK, tiny.LIMITS, variables, encoded)
    with pytest.raises(InputError, match=r"^resolution scale [^\n]*\Z"):
        image.shade_image(*arguments, *ground_picture(), resolution_scale=scale)


def test_a_lower_rate_settles_for_limits_that_fit(variables, encoded, monkeypatch):
    """The next image goes on in them, and they stay."""
    monkeypatch.setattr(blocks, "BLOCK", 128)
    arguments = variables, encoded, *ground_picture()
    limits, made = tiny.LIMITS, []
    for _ in range(2):
        given = tiny.NETWORK, limits, *arguments
        picture, limits = image.shade_image(*given, resolution_scale=0.5)
        made.append((picture, limits))
    assert made[0][1] == made[1][1]
    assert limits.of("query.edges") < tiny.LIMITS.of("query.edges")
    np.testing.assert_allclose(made[1][0], made[0][0], atol=1e-6)

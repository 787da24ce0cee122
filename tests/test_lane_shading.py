"""f_2D in lanes says what it says in blocks, whatever the network and the queries."""

from dataclasses import replace
from functools import cache

import jax
import numpy as np
import pytest
import tiny
from test_relight import EFFECTS, lit

from ginn_jax import (
    block_shading,
    image,
    inference,
    lane_fields,
    lane_shading,
    presets,
    train,
)
from ginn_jax.errors import InputError
from ginn_jax.lit_clouds import network_numbers
from ginn_jax.process import LOG
from ginn_jax.searches import uniform_limits

pytestmark = pytest.mark.usefixtures("cheap_compiling")

KEY = jax.random.key(2)
FEW_LAYERS = tuple(
    replace(conv, before=before)
    for conv, before in zip(
        tiny.NETWORK.encoder, ("raw", "norm", "dense", "norm"), strict=True
    )
)
NETWORKS = {name: n for name, n in EFFECTS.items() if not n.splat} | {
    "occlusion": replace(tiny.NETWORK, taper=0.4, sided=True),
    "offsets": replace(tiny.ONE_LEVEL, oriented=False, norm="none"),
    "kernels in blocks": replace(tiny.NETWORK, group=3, encoder=FEW_LAYERS),
    "smooth": replace(EFFECTS["beams"], smooth=0.1, taper=0.4, sided=True),
}
OTHERS = {
    "splat": EFFECTS["only_3d"],
    "density per pair": replace(tiny.ONE_LEVEL, density="kde"),
    "running moments": replace(tiny.ONE_LEVEL, norm="batch"),
    "mixing": replace(
        tiny.ONE_LEVEL, query=replace(tiny.ONE_LEVEL.query, mixes=True, before="raw")
    ),
    "wide": replace(tiny.ONE_LEVEL, latent=2048),
    "many small kernels": replace(tiny.ONE_LEVEL, latent=64, hidden=32, group=1),
    "wide head": replace(presets.DEFAULTS["sss"], head=1024),
    "wide beams": replace(presets.DEFAULTS["sss"], beams=2000),
    "dense before": replace(
        tiny.ONE_LEVEL, query=replace(tiny.ONE_LEVEL.query, before="dense")
    ),
}


@cache
def case(name):
    """A network, weights of which none is 0 or 1, codes and queries with numbers."""
    network = NETWORKS[name]
    config = replace(tiny.CONFIG, network=network)
    variables = jax.device_get(train.init_state(config).variables)
    rng = np.random.default_rng(0)
    variables = jax.tree.map(
        lambda a: np.float32(a + 0.2 * rng.standard_normal(a.shape)), variables
    )
    medium = (8.0, 1.3) if network.materials == 3 else ()
    cloud, queries = lit(1000, 1, medium), lit(300, 2, medium)
    numbers = network_numbers(cloud) if network.lights else (None, None)
    limits = uniform_limits(network, 1 << 15)
    ends = variables, cloud.position, cloud.normal, *numbers
    encoded, _ = inference.encode_cloud(network, limits, *ends, key=KEY)
    numbers = (None, None)
    if network.asks == "all":
        numbers = network_numbers(queries)
    asked = queries.position, queries.normal, *numbers
    return network, limits, variables, encoded, asked


@pytest.mark.parametrize("name", NETWORKS)
def test_lanes_say_what_blocks_say(name):
    network, limits, variables, encoded, asked = case(name)
    assert lane_shading.lanes_for(network)
    found, same = inference.shade_points(network, limits, variables, encoded, *asked)
    assert same == limits
    expected, _ = block_shading.shade_blocks(
        network, limits, variables, encoded, *asked
    )
    assert found.shape == expected.shape
    assert found.dtype == np.float32
    assert expected.std() > 1e-3 * np.abs(expected).max() > 0
    # A norm over two channels makes much of their rounding.
    tolerance = 1e-5 if network.latent > 2 else 2e-4
    np.testing.assert_allclose(
        found, expected, rtol=0, atol=tolerance * np.abs(expected).max()
    )
    shaded = lane_shading.shade_in_lanes(network, variables, encoded, *asked)
    turn = block_shading.make_turns(encoded.scale is not None, encoded.center, *asked)
    made = block_shading.shade_turns(network, variables, encoded, turn, False, limits)
    pairs = sum(int(np.sum(d[f"{network.query.name}.edges"])) for d in made[1])
    assert shaded.pairs == pairs > 300
    assert not shaded.doubtful


@pytest.mark.parametrize("presets_of", [presets.ILLUMINATION, presets.SCATTERING])
@pytest.mark.parametrize("name", ["homogeneous", "linear", "narrow", "wide", "only_2d"])
def test_presets_run_in_lanes(presets_of, name):
    assert lane_shading.lanes_for(presets_of[name])
    assert lane_shading.lanes_for(presets.PRESETS["default"])
    assert not lane_shading.lanes_for(presets_of["released"])


@pytest.mark.parametrize("name", OTHERS)
def test_other_networks_are_shaded_in_blocks(name):
    assert not lane_shading.lanes_for(OTHERS[name])


def picture(mask, asked):
    """The queries as pixels, in any places; not a number outside the mask."""

    def spread(numbers):
        image = np.full((*numbers.shape[:-2], *mask.shape, numbers.shape[-1]), np.nan)
        image[..., mask, :] = numbers
        return image.astype(np.float32)

    position, normal, *numbers = asked
    numbers = [a if a is None else spread(a) for a in numbers]
    return spread(position), spread(normal), numbers


def shade_picture(name, mask, **change):
    network, limits, variables, encoded, asked = case(name)
    position, normal, (material, light) = picture(mask, asked)
    given = {"position": position, "normal": normal, "material": material}
    given |= {"light": light} | change
    return image.shade_image(
        network, limits, variables, encoded, mask=mask, background=7.0, **given
    )[0]


MASK = np.random.default_rng(1).permutation(24 * 25).reshape(24, 25) < 300


@pytest.mark.parametrize("name", ["occlusion", "smooth"])
def test_pixels_are_points(name):
    network, limits, variables, encoded, asked = case(name)
    values, _ = inference.shade_points(network, limits, variables, encoded, *asked)
    found = shade_picture(name, MASK)
    assert (found[~MASK] == 7).all()
    np.testing.assert_allclose(found[MASK], image.within_range(encoded, values))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("position", r"points holds non-finite"),
        ("normal", "normals are non-finite or not of unit length"),
        ("material", "material holds non-finite"),
        ("light", "light holds non-finite"),
    ],
)
def test_one_bad_pixel_is_refused(change, message):
    """It is found in the lanes, where all are shaded before anything else is known."""
    asked = case("smooth")[-1]
    position, normal, (material, light) = picture(MASK, asked)
    given = {"position": position, "normal": normal, "material": material}
    given |= {"light": light}
    row = tuple(np.argwhere(MASK)[17])
    bad = {np.inf: message, np.nan: message}
    if change == "position":
        bad |= dict.fromkeys([-1.01e18, 1e20], r"points holds coordinates beyond 1e")
    if change == "normal":
        bad[2] = message
    if change == "light":
        bad |= dict.fromkeys([-1, -1e-40], "light holds numbers below 0")
    for number, said in bad.items():
        given[change][(..., *row, 0)] = number
        with pytest.raises(InputError, match=rf"^{said}[^\n]*\Z"):
            shade_picture("smooth", MASK, **given)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"material": np.ones((3, 24, 25, 2))}, r"material is \(3, 300, 2\), the netw"),
        ({"light": None}, r"light is \(0,\), the network takes \[C 300 1\]"),
        ({"light": np.ones((2, 24, 25, 1))}, r"codes have \[2, 3\] channels"),
        ({"position": np.ones((24, 25, 3), "U1")}, "points holds <U1: give real"),
        ({"normal": np.ones((24, 25, 3), complex)}, "normals holds complex128"),
    ],
)
def test_what_does_not_fit_is_refused(change, message, unchecked):
    with pytest.raises(InputError, match=rf"^[^\n]*{message}[^\n]*\Z"):
        shade_picture("smooth", MASK, **change)


@pytest.mark.parametrize("scale", [1.0, 0.5, 1 / 3])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("name", ["occlusion", "beams"])
def test_images_are_those_of_blocks(name, kind, scale, monkeypatch):
    """Of level ground with a gap, at any rate, some of it brighter than can be."""
    network, limits, variables, encoded, _ = case(name)
    loud = jax.tree.map(np.array, variables)
    loud["shader"]["params"]["Dense_1"]["kernel"] *= 3
    x, z = np.meshgrid(np.linspace(-0.6, 0.6, 32), np.linspace(-0.6, 0.6, 30))
    position = np.stack([x, np.zeros_like(x), z], axis=-1).astype(kind)
    normal = np.broadcast_to(np.array([0, 1, 0], kind), position.shape)
    mask = np.abs(x - 0.11) > 0.05
    numbers = {}
    if network.lights:
        ones = np.ones((3, *mask.shape, 1), kind)
        numbers = {
            "material": np.repeat(ones, 3, -1) / 2,
            "light": ones * (1 + x**2)[..., None],
        }
    given = network, limits, loud, encoded, position, normal, mask, 7.0, scale
    found, same = image.shade_image(*given, **numbers)
    assert same == limits
    monkeypatch.setattr(image, "lanes_for", lambda network: False)
    expected, _ = image.shade_image(*given, **numbers)
    size = np.abs(expected[mask]).max()
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-4 * size)
    assert (found[~mask] == 7).all()
    assert found[mask].min() == 0
    assert found.dtype == np.float32


def test_no_pixel_is_background():
    network, limits, variables, encoded, _ = case("beams")
    blank, nothing = np.full((5, 4, 3), np.nan, np.float32), np.zeros((5, 4), bool)
    numbers = {"material": np.ones((3, 5, 4, 3)), "light": np.ones((3, 5, 4, 1))}
    given = network, limits, variables, encoded, blank, blank, nothing
    found, _ = image.shade_image(*given, **numbers)
    np.testing.assert_array_equal(found, np.ones((5, 4, 3), np.float32))


def test_limits_of_another_network_are_refused():
    network, _, variables, encoded, asked = case("occlusion")
    other = uniform_limits(presets.RELEASED, 64)
    with pytest.raises(InputError, match=r"^the limits lack [^\n]*\Z"):
        inference.shade_points(network, other, variables, encoded, *asked)
    position, normal, _ = picture(MASK, asked)
    with pytest.raises(InputError, match=r"^the limits lack [^\n]*\Z"):
        image.shade_image(network, other, variables, encoded, position, normal, MASK)


def test_numbers_may_be_of_any_real_type(unchecked):
    network, _, variables, encoded, asked = case("occlusion")
    shade = lane_shading.shade_in_lanes
    position, normal = (np.round(8 * a) / 8 for a in asked[:2])
    expected = shade(network, variables, encoded, position, normal).values
    for kind in (np.float64, np.float16):
        ends = position.astype(kind), normal.astype(kind)
        found = shade(network, variables, encoded, *ends).values
        np.testing.assert_allclose(found, expected, atol=1e-6)
    whole = np.round(position).astype(np.int64)
    ends = normal.astype(np.float32)
    np.testing.assert_array_equal(
        shade(network, variables, encoded, whole, ends).values,
        shade(network, variables, encoded, whole.astype(np.float32), ends).values,
    )


def test_rows_are_taken_in_any_order_and_may_be_none():
    network, _, variables, encoded, asked = case("smooth")
    whole = lane_shading.shade_in_lanes(network, variables, encoded, *asked)
    rows = np.array([299, 5, 5, 0, 100])
    some = lane_shading.shade_in_lanes(network, variables, encoded, *asked, rows=rows)
    np.testing.assert_allclose(some.values, whole.values[rows], rtol=1e-6)
    rows = rows[:0]
    none = lane_shading.shade_in_lanes(network, variables, encoded, *asked, rows=rows)
    assert none.values.shape == (0, 3)
    assert none.pairs == 0


def test_queries_far_away_find_nothing_and_disturb_no_other():
    network, _, variables, encoded, asked = case("occlusion")
    position = asked[0].copy()
    position[:50] += np.float32([30, -40, 500])
    position[50] = 1e18
    shade = lane_shading.shade_in_lanes
    found = shade(network, variables, encoded, position, asked[1])
    assert np.isfinite(found.values).all()
    expected = shade(network, variables, encoded, *asked[:2])
    np.testing.assert_array_equal(found.values[51:], expected.values[51:])
    assert shade(network, variables, encoded, position[:51], asked[1][:51]).pairs == 0


def test_without_libllvm_there_are_blocks(monkeypatch, caplog):
    def missing():
        raise InputError("Dr.Jit needs libLLVM")

    monkeypatch.setattr(lane_fields, "use_drjit", missing)
    usable = lane_fields.lanes_usable.__wrapped__
    assert not usable()
    assert [r.name for r in caplog.records] == [LOG.name]
    assert "Dr.Jit needs libLLVM" in caplog.text

"""Relighting gives what shading from scratch gives, and both are linear in light."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import tiny

from ginn_jax import blocks, inference, train
from ginn_jax import limits as lm
from ginn_jax.errors import InputError
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.presets import only_2d, only_3d
from ginn_jax.relight import prepare_relighting, relight
from ginn_jax.searches import limit_names, uniform_limits

KEY = jax.random.key(1)
LOCAL = replace(tiny.ONE_LEVEL, materials=3, lights=1, asks="all", local=True)
# Pooling and its way back once for what is linear, and once where nothing but f_3D can
# be nonlinear.
EFFECTS = {
    "linear": replace(tiny.NETWORK, linear=True, smooth=0.1, materials=1, lights=1),
    "homogeneous": replace(tiny.ONE_LEVEL, materials=1, lights=1),
    "beams": replace(LOCAL, beams=2),
    "only_2d": only_2d(LOCAL),
    "only_3d": only_3d(
        replace(tiny.NETWORK, materials=3, lights=1, asks="all", local=True, beams=2)
    ),
}


pytestmark = pytest.mark.usefixtures("cheap_compiling")


@pytest.fixture(autouse=True)
def _small_blocks(monkeypatch):
    monkeypatch.setattr(blocks, "BLOCK", 512)


def limits_of(network):
    """The tiny network's, or large ones where the table is another."""
    known = set(limit_names(network)) == set(limit_names(tiny.NETWORK))
    return tiny.LIMITS if known else uniform_limits(network, 1 << 15)


def lit(count, seed, medium=(), size=1.0):
    """The sphere on its plane, two materials, random light on every point."""
    points = tiny.sphere_on_plane(count, seed)
    rng = np.random.default_rng(seed)
    light = rng.gamma(0.5, size=(3, count, 3)).astype(np.float32)
    albedo = rng.uniform(0, 1, (2, 3)).astype(np.float32)
    material = (points.position[:, 1] < 1e-6).astype(np.int32)
    columns = np.float32(size) * points.position, points.normal, material, *light
    return LitCloud(*columns, albedo, np.array(medium))


@pytest.fixture(scope="module", params=EFFECTS)
def case(request):
    """A network with its weights, a cloud and queries."""
    network = EFFECTS[request.param]
    medium = (8.0, 1.3) if network.materials == 3 else ()
    config = replace(tiny.CONFIG, network=network)
    variables = jax.device_get(train.init_state(config).variables)
    return network, variables, lit(1000, 1, medium), lit(300, 2, medium)


def shade(network, variables, cloud, queries):
    ends = variables, cloud.position, cloud.normal, *network_numbers(cloud)
    encoded, limits = inference.encode_cloud(
        network, limits_of(network), *ends, key=KEY
    )
    ends = variables, encoded, queries.position, queries.normal
    numbers = network_numbers(queries)
    return inference.shade_points(network, limits, *ends, *numbers)[0]


def scaled(cloud, factor):
    return cloud._replace(irradiance=np.float32(factor) * cloud.irradiance)


def close(a, b, tolerance=1e-4):
    np.testing.assert_allclose(a, b, atol=tolerance * np.abs(b).max())


def test_output_scales_with_light(case):
    network, variables, cloud, queries = case
    once = shade(network, variables, cloud, queries)
    assert np.abs(once).max() > 1e-3
    for factor in (1e-4, 3.0, 1e5):
        more = scaled(cloud, factor), scaled(queries, factor)
        close(shade(network, variables, *more) / factor, once)


def test_no_light_gives_none(case):
    network, variables, cloud, queries = case
    dark = shade(network, variables, scaled(cloud, 0), scaled(queries, 0))
    np.testing.assert_array_equal(dark, 0)


def test_channels_are_alike(case):
    network, variables, cloud, queries = case
    once = shade(network, variables, cloud, queries)

    def swapped(c):
        return c._replace(irradiance=c.irradiance[:, ::-1], albedo=c.albedo[:, ::-1])

    turned = shade(network, variables, swapped(cloud), swapped(queries))
    close(turned[:, ::-1], once, 1e-5)


def test_lights_add_up_where_the_network_is_linear(case):
    network, variables, cloud, queries = case
    rng = np.random.default_rng(5)
    others = [
        c._replace(irradiance=rng.gamma(0.3, size=c.irradiance.shape).astype("f4"))
        for c in (cloud, queries)
    ]
    both = [
        c._replace(irradiance=c.irradiance + o.irradiance)
        for c, o in zip((cloud, queries), others, strict=True)
    ]
    parts = [shade(network, variables, *c) for c in ((cloud, queries), others)]
    whole = shade(network, variables, *both)
    if network.linear:
        close(parts[0] + parts[1], whole)
    else:
        assert np.abs(parts[0] + parts[1] - whole).max() > 1e-3 * np.abs(whole).max()


def test_relighting_is_shading(case, monkeypatch):
    network, variables, cloud, queries = case
    if network != EFFECTS["homogeneous"]:  # one that is fitted to the scene will do
        monkeypatch.setattr(lm, "LOOSE", np.inf)
    given = network, limits_of(network), variables, cloud, queries
    ready, _ = prepare_relighting(*given, key=KEY)
    rng = np.random.default_rng(7)
    for factor in (1.0, 20.0):
        lights = [
            c._replace(
                irradiance=rng.gamma(factor, size=c.irradiance.shape).astype("f4")
            )
            for c in (cloud, queries)
        ]
        expected = np.maximum(shade(network, variables, *lights), 0)
        close(relight(network, variables, ready, *lights), expected)
    if network.asks == "all":
        with pytest.raises(InputError, match=r"^light of queries holds non-finite"):
            relight(network, variables, ready, cloud, scaled(queries, np.nan))


@pytest.mark.parametrize("case", ["homogeneous"], indirect=True)
def test_queries_out_of_reach_have_values_in_either_way(case):
    """Nothing is found near them: the capacities measured are of nothing."""
    network, variables, cloud, queries = case
    far = queries._replace(position=queries.position + np.float32([9, 0, 0]))
    ready, limits = prepare_relighting(
        network, limits_of(network), variables, cloud, far, key=KEY
    )
    values = relight(network, variables, ready, cloud, far)
    assert np.isfinite(values).all()
    again, _ = prepare_relighting(network, limits, variables, cloud, far, key=KEY)
    close(relight(network, variables, again, cloud, far), values)


@pytest.fixture(scope="module")
def prepared():
    network = EFFECTS["homogeneous"]
    config = replace(tiny.CONFIG, network=network)
    variables = jax.device_get(train.init_state(config).variables)
    given = network, limits_of(network), variables, lit(400, 1)
    return given, prepare_relighting(*given, lit(0, 2), key=KEY)[0]


def test_no_queries_have_no_values(prepared):
    (network, _, variables, cloud), ready = prepared
    assert relight(network, variables, ready, cloud, lit(0, 2)).shape == (0, 3)


@pytest.mark.parametrize(
    ("cloud", "queries", "message"),
    [
        (lit(399, 1), lit(0, 2), "the cloud has 399 points, 400 were prepared"),
        (lit(400, 1), lit(5, 2), "queries has 5 points, 0 were prepared"),
        (scaled(lit(400, 1), np.nan), lit(0, 2), "^light holds non-finite"),
    ],
)
def test_what_was_not_prepared_is_refused(prepared, cloud, queries, message):
    (network, _, variables, _), ready = prepared
    with pytest.raises(InputError, match=message):
        relight(network, variables, ready, cloud, queries)


@pytest.mark.parametrize(
    ("network", "cloud", "message"),
    [
        (tiny.ONE_LEVEL, lit(400, 1), "the network takes no light"),
        (EFFECTS["homogeneous"], lit(0, 1), "the cloud is empty"),
        (
            EFFECTS["homogeneous"],
            lit(400, 1, size=1e19),
            "the cloud holds coordinates beyond",
        ),
        (EFFECTS["homogeneous"], lit(400, 1), "the weights are not"),
    ],
)
def test_what_cannot_be_lit_is_not_prepared(network, cloud, message):
    with pytest.raises(InputError, match=message):
        prepare_relighting(network, limits_of(network), {}, cloud, lit(5, 2), key=KEY)


def test_beams_are_linear_once_features_are_blind_to_light():
    network = EFFECTS["beams"]
    config = replace(tiny.CONFIG, network=network)
    variables = jax.device_get(train.init_state(config).variables)
    first = variables["encoder"]["params"][network.encoder[0].name]["Dense_0"]
    first["kernel"] = np.concatenate([first["kernel"][:-1], 0 * first["kernel"][-1:]])
    rng, cloud = np.random.default_rng(3), lit(1000, 1, (8.0, 1.3))

    def carried(irradiance):
        numbers = network_numbers(cloud._replace(irradiance=irradiance))
        ends = variables, cloud.position, cloud.normal, *numbers
        given = network, limits_of(network), *ends
        encoded, _ = inference.encode_cloud(*given, key=KEY)
        assert encoded.code.light.shape[-1] == 1 + network.beams
        return np.asarray(encoded.code.light) * np.asarray(encoded.scale)[:, None, None]

    one, two = rng.gamma(0.3, size=(2, *cloud.irradiance.shape)).astype(np.float32)
    close(carried(one) + carried(two), carried(one + two))
    assert np.abs(carried(one)[..., 1:]).min(axis=-1).max() > 0

"""f_3D in lanes makes the codes that JAX makes, whatever the network and the cloud."""

from dataclasses import replace

import jax
import numpy as np
import pytest
import tiny
from test_lane_shading import NETWORKS, OTHERS, case
from test_relight import lit

from ginn_jax import (
    inference,
    lane_convolutions,
    lane_disks,
    lane_encoding,
    lane_fields,
    lane_rows,
    lanes,
    presets,
    train,
)
from ginn_jax.lit_clouds import network_numbers
from ginn_jax.searches import uniform_limits

pytestmark = pytest.mark.usefixtures("cheap_compiling")

KEY = jax.random.key(3)


def encode(network, variables, cloud, numbers, kept_before=None, in_lanes=True):
    limits = uniform_limits(network, 1 << 15)
    ends = variables, cloud.position, cloud.normal, *numbers, kept_before
    with pytest.MonkeyPatch.context() as patch:
        if not in_lanes:
            patch.setattr(inference, "encodes_in_lanes", lambda network: False)
        encoded, same = inference.encode_cloud(network, limits, *ends, key=KEY)
    assert (encoded.grid is None) == in_lanes
    assert same == limits or not in_lanes
    return encoded


def scene(name):
    network, _, variables, _, _ = case(name)
    medium = (8.0, 1.3) if network.materials == 3 else ()
    cloud = lit(1500, 4, medium)
    return (
        network,
        variables,
        cloud,
        network_numbers(cloud)
        if network.lights
        else (
            None,
            None,
        ),
    )


def in_order(encoded):
    """Real points sorted by place, with their area and codes, channels first."""
    mask = np.asarray(encoded.points.mask)
    place = np.asarray(encoded.points.position)[mask]
    order = np.flatnonzero(mask)[np.lexsort(place.T)]
    codes = [np.asarray(a) for a in encoded.code if a is not None]
    codes = [a if a.ndim == 3 else a[None] for a in codes]
    ends = (np.asarray(a)[order] for a in (*encoded.points[:2], encoded.area))
    return *ends, np.concatenate(codes, axis=2)[:, order]


def assert_alike(network, found, expected):
    np.testing.assert_array_equal(found.kept, expected.kept)
    assert found.points.mask.all()
    for name, a, b in zip(
        ("position", "normal", "area", "code"),
        in_order(found),
        in_order(expected),
        strict=True,
    ):
        assert a.dtype == np.float32
        # A norm over two channels makes much of their rounding.
        tolerance = 1e-5 if name != "code" else 3e-4
        scale = np.abs(b).max()
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * scale, err_msg=name)
        assert b.std() > 1e-3 * scale > 0
    for a, b in ((found.scale, expected.scale), (found.center, expected.center)):
        assert (a is None) == (b is None)
        if b is not None:
            np.testing.assert_allclose(a, b, rtol=1e-5)


@pytest.mark.parametrize("name", NETWORKS)
def test_lanes_encode_what_jax_encodes(name):
    given = scene(name)
    assert lane_encoding.encodes_in_lanes(given[0])
    assert_alike(given[0], encode(*given), encode(*given, in_lanes=False))


@pytest.mark.parametrize("few", [1, 1 << 12])
def test_what_was_kept_before_is_kept_again(few, monkeypatch):
    """Thrown in two waves, and at once."""
    monkeypatch.setattr(lane_disks, "FEW", few)
    network, variables, cloud, numbers = scene("occlusion")
    before = inference.nothing_kept(network, 1500)
    before[:, :1500:7] = True
    given = network, variables, cloud, numbers, before
    found = encode(*given)
    assert_alike(network, found, encode(*given, in_lanes=False))
    again = encode(*given[:4], found.kept)
    np.testing.assert_array_equal(again.kept, found.kept)
    assert (encode(*given[:4]).kept != found.kept).any()


def test_nothing_kept_before_changes_no_codes():
    network, variables, cloud, numbers = scene("occlusion")
    given = network, variables, cloud, numbers
    nothing = inference.nothing_kept(network, 1500)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lane_disks, "FEW", 1)
        found = encode(*given, nothing)
    np.testing.assert_array_equal(found.kept, encode(*given).kept)


@pytest.mark.parametrize("count", [1, 2, 70])
def test_few_samples_have_codes(count):
    network, variables, cloud, _ = scene("occlusion")
    few = jax.tree.map(lambda a: a[:count], cloud)
    given = network, variables, few, (None, None)
    assert_alike_but_spread(encode(*given), encode(*given, in_lanes=False))


def assert_alike_but_spread(found, expected):
    for a, b in zip(in_order(found), in_order(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * max(np.abs(b).max(), 1))


def test_wide_layers_sum_a_channel_at_a_time(monkeypatch):
    given = scene("beams")
    whole = encode(*given)
    monkeypatch.setattr(lane_convolutions, "MOST_SUMS", 1)
    for a, b in zip(in_order(encode(*given)), in_order(whole), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", ["beams", "linear", "kernels in blocks"])
def test_large_layers_of_rows_are_left_to_jax(name, monkeypatch):
    given = scene(name)
    whole = encode(*given)
    monkeypatch.setattr(lane_rows, "MOST_WEIGHTS", 0)
    assert_alike(given[0], encode(*given), whole)


def test_levels_that_nothing_asks_for_are_kept_too():
    """Without convolutions f_3D is layers of the finest points alone."""
    network = replace(tiny.NETWORK, encoder=())
    config = replace(tiny.CONFIG, network=network)
    variables = jax.device_get(train.init_state(config).variables)
    given = network, variables, *scene("occlusion")[2:]
    found = encode(*given)
    assert_alike(network, found, encode(*given, in_lanes=False))
    assert len(found.kept) == 2


def shapes(presets_of):
    """Networks that run in lanes, with what each layer of f_3D is."""
    for network in presets_of.values():
        if lane_encoding.encodes_in_lanes(network):
            config = replace(tiny.CONFIG, network=network)
            state = train.state_shapes(config)
            yield network, state.variables["encoder"]["params"]


@pytest.mark.parametrize(
    "presets_of", [presets.PRESETS, presets.ILLUMINATION, presets.SCATTERING]
)
def test_widths_are_those_of_the_layers(presets_of):
    for network, params in shapes(presets_of):
        *widths, last = lane_rows.feature_widths(network)
        for conv, width in zip(network.encoder, widths, strict=True):
            *_, bias = params[conv.name]["kernel"]
            assert bias.shape[0] * bias.shape[1] >= sum(width)
            group = network.group or sum(width)
            assert bias.shape == (-(-sum(width) // group), min(group, sum(width)))
            if conv.before in ("dense", "lift"):
                assert params[conv.name]["Dense_0"]["kernel"].shape[1] == width.free
            if width.light:
                gate = params[conv.name]["Gate_0"]["light"]["kernel"]
                assert gate.shape[1] == width.light
        assert params["latent"]["kernel"].shape[1] == last.free
        own = network.lights if network.local else 0
        gate = params.get("latent_light")
        assert last.light - own == (gate["light"]["kernel"].shape[1] if gate else 0)


def shifted(numbers):
    """The same numbers elsewhere in memory, four bytes off."""
    memory = np.empty(numbers.size + 1, numbers.dtype)
    memory[1:] = numbers.reshape(-1)
    return memory[1:].reshape(numbers.shape)


@pytest.mark.parametrize(("name", "programs"), [("smooth", 5), ("linear", 12)])
def test_nothing_is_traced_twice(name, programs, monkeypatch):
    """Whatever memory the caller's arrays lie in, and however many points they are; but
    for disks, whose rounds may ask as many samples as they have or have not."""
    made, given = [], scene(name)

    def kept(function, *static):
        made.append(program(function, *static))
        return made[-1]

    program = lanes.program
    for module in (lane_convolutions, lane_encoding, lane_fields):
        monkeypatch.setattr(module, "program", kept)
    network, variables, cloud, numbers = given
    encode(*given)
    before = [run.n_recordings for run in made]
    assert len(before) == programs
    for count in (1500, 1400, 1300):
        part = cloud._replace(
            position=shifted(cloud.position[:count]),
            normal=shifted(cloud.normal[:count]),
        )
        less = [a if a is None else shifted(a[:, :count]) for a in numbers]
        made.clear()
        encode(network, variables, part, less)
        assert [run.n_recordings for run in made] == before


def test_weights_that_change_are_not_mixed_up():
    """Programs are kept by what their weights are."""
    network, variables, cloud, numbers = scene("occlusion")
    other = jax.tree.map(lambda a: np.float32(a * 1.1), variables)
    first = encode(network, variables, cloud, numbers)
    second = encode(network, other, cloud, numbers)
    assert_alike(
        network, second, encode(network, other, cloud, numbers, in_lanes=False)
    )
    assert np.abs(first.code.free - second.code.free).max() > 0.01


@pytest.mark.parametrize("name", ["homogeneous", "linear", "narrow", "wide", "only_3d"])
@pytest.mark.parametrize("presets_of", [presets.ILLUMINATION, presets.SCATTERING])
def test_presets_run_in_lanes(presets_of, name):
    assert lane_encoding.encodes_in_lanes(presets_of[name])
    assert not lane_encoding.encodes_in_lanes(presets_of["released"])


MIXING = replace(tiny.NETWORK.encoder[0], mixes=True, before="raw")
WIDE = replace(tiny.NETWORK.encoder[0], channels=2048)


@pytest.mark.parametrize(
    "network",
    [
        OTHERS["density per pair"],
        OTHERS["running moments"],
        replace(tiny.NETWORK, encoder=(MIXING, *tiny.NETWORK.encoder[1:])),
        replace(tiny.NETWORK, encoder=(WIDE, *tiny.NETWORK.encoder[1:])),
    ],
    ids=["density per pair", "running moments", "mixing", "wide"],
)
def test_other_networks_are_encoded_by_jax(network):
    assert not lane_encoding.encodes_in_lanes(network)

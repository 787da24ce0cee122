"""The tables of layers against the authors'."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import pytest

from ginn_jax.architecture import QUERY
from ginn_jax.geometry import Geometry
from ginn_jax.network import Encoder, Shader
from ginn_jax.presets import ILLUMINATION, PAPER, RELEASED, SCATTERING
from ginn_jax.receptive_field import Field, Oriented

# From the authors' release: levels, radius, bandwidth, channels, channels with skip,
# parameters of the kernel for 5 attributes, and of the 1x1 layer before it.
RELEASED_ROWS = {
    "conv_1": (0, 0, 0.025, 0.25, 8, 8, 560, 0),
    "pool_1": (0, 1, 0.05, 0.2, 16, 16, 224, 144),
    "conv_2": (1, 1, 0.1, 0.25, 16, 32, 224, 272),
    "pool_2": (1, 2, 0.2, 0.2, 32, 32, 448, 1056),
    "conv_3": (2, 2, 0.2, 0.25, 32, 64, 448, 1056),
    "pool_3": (2, 3, 0.4, 0.2, 64, 64, 896, 4160),
    "conv_4": (3, 3, 1.0, 0.2, 64, 64, 896, 4160),
    "up_3": (3, 2, 0.4, 0.2, 64, 128, 896, 0),
    "up_2": (2, 1, 0.2, 0.2, 32, 64, 448, 4128),
    "up_1": (1, 0, 0.1, 0.2, 16, 24, 224, 1040),
    "query": (0, QUERY, 0.05, 0.2, 8, 8, 112, 0),
}


def unfilled(network, attributes, query_attributes):
    """Shapes of all variables, from a geometry that has the right ranks only."""
    rows, edges = 8, 4
    zeros = jnp.zeros((rows, 3))
    level = Oriented(zeros, zeros, jnp.ones(rows, bool))
    index = jnp.zeros(edges, jnp.int32)
    inputs = jnp.zeros((7 if network.oriented else 3, edges))
    field = Field(index, index, inputs, jnp.zeros(edges), jnp.int32(edges))
    fields = {c.name: field for c in network.encoder}
    geometry = Geometry((level,) * 4, index, fields, None, None)

    def init(key):
        codes, encoder = Encoder(network, True).init_with_output(
            key, jnp.zeros((rows, attributes)), None, geometry
        )
        shader = Shader(network, True).init(
            key,
            codes,
            jnp.zeros((rows, query_attributes)),
            None,
            level.mask,
            field,
            level.mask,
        )
        return encoder, shader

    return jax.eval_shape(init, jax.random.key(0))


def size(tree):
    return sum(leaf.size for leaf in jax.tree.leaves(tree))


@pytest.fixture(scope="module")
def released():
    """Parameters of the released network for indirect light: 5 inputs, 3 at queries."""
    encoder, shader = unfilled(RELEASED, 5, 3)
    return encoder["params"], shader["params"]


def test_released_table_is_the_authors():
    assert RELEASED.levels == (0.01, 0.05, 0.1, 0.2)
    rows = (*RELEASED.encoder, RELEASED.query)
    assert [c.name for c in rows] == list(RELEASED_ROWS)
    for c in rows:
        expected = RELEASED_ROWS[c.name]
        assert (c.source, c.target) == expected[:2]
        assert (c.radius, c.bandwidth) == pytest.approx(expected[2:4])
    assert [c.name for c in rows if c.mixes] == ["conv_1"]
    skips = {c.name: c.skip for c in rows if c.skip}
    assert skips == {
        "conv_2": "pool_1",
        "conv_3": "pool_2",
        "up_3": "conv_3",
        "up_2": "conv_2",
        "up_1": "conv_1",
    }


@pytest.mark.parametrize("name", RELEASED_ROWS)
def test_released_layer_has_the_authors_parameters(released, name):
    *_, kernel, dense = RELEASED_ROWS[name]
    layer = released[name == "query"][name]
    assert size(layer["kernel"]) == kernel
    assert size(layer.get("Dense_0", {})) == dense


def test_released_channels_are_the_authors(released):
    encoder, shader = released
    wide, previous = [row[5] for row in RELEASED_ROWS.values()], None
    for name, channels in zip(list(RELEASED_ROWS)[:-1], wide, strict=False):
        if name != "conv_1":
            norm = encoder[name]["Norm_0"]["BatchNorm_0"]
            assert norm["scale"].shape == norm["bias"].shape == (previous,)
        previous = channels
    assert encoder["latent"]["kernel"].shape == (24, 8)
    assert shader["Dense_0"]["kernel"].shape == (11, 8)
    assert shader["Dense_1"]["kernel"].shape == (8, 1)


def test_released_network_is_as_large_as_the_authors(released):
    encoder, shader = released
    layers = [
        layer for name, layer in (encoder | shader).items() if name in RELEASED_ROWS
    ]
    assert len(layers) == 11
    assert size([layer["kernel"] for layer in layers]) == 5376
    assert size(released) == 23281


def test_paper_differs_in_radii_and_blocks():
    assert PAPER.levels == (0.01, 0.05, 0.15, 0.5)
    assert (PAPER.hidden, PAPER.group) == (8, 8)
    radii = {c.name: c.radius for c in PAPER.encoder}
    assert radii["pool_3"] == radii["conv_4"] == radii["up_3"] == 1.0
    assert radii["pool_2"] == radii["conv_3"] == radii["up_2"] == 0.3
    encoder, _ = unfilled(PAPER, 3, 3)
    # Blocks 3-8-8-8: 176 parameters for 8 values.
    assert size(encoder["params"]["conv_1"]["kernel"]) == 3 * 176
    assert size(encoder["params"]["conv_4"]["kernel"]) == 8 * 176


@pytest.mark.parametrize("table", [ILLUMINATION, SCATTERING], ids=["gi", "sss"])
def test_widths_differ_in_channels_alone(table):
    usual = table["homogeneous"]
    for name, factor in (("narrow", 0.5), ("wide", 2)):
        other = table[name]
        rows, usual_rows = ((*n.encoder, n.query) for n in (other, usual))
        for row, conv in zip(rows, usual_rows, strict=True):
            assert row == replace(conv, channels=int(factor * conv.channels))
        assert (other.latent, other.head) == (
            factor * usual.latent,
            factor * usual.head,
        )
        same = {n: getattr(usual, n) for n in ("encoder", "query", "latent", "head")}
        assert replace(other, **same) == usual

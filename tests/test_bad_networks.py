"""Networks, trainings and what is given to them, or measured, that cannot be meant.

Each refused in one line that names the argument.
"""

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest
import tiny
from refusals import (
    INF,
    KEY,
    NAN,
    POINTS,
    RAGGED,
    UP,
    WORDS,
    Table,
    assert_refused,
    each_row,
)

from ginn_jax import image, inference, metrics, objective, presets
from ginn_jax.example import blank_example
from ginn_jax.network import Code
from ginn_jax.searches import uniform_limits
from ginn_jax.shading import Encoded

HALF = np.ones((20, 3), np.float16)
PICTURE = np.ones((12, 12))
FRAME = {"position": POINTS.reshape(4, 5, 3), "normal": UP.reshape(4, 5, 3)}


def encode(network=tiny.NETWORK, limits=tiny.LIMITS, variables=None, **change):
    """Nothing is computed: what is wrong is said before."""
    given = {"position": POINTS, "normal": UP, "key": KEY} | change
    return inference.encode_cloud(network, limits, variables or {}, **given)


def shade(network=tiny.NETWORK, variables=None, encoded=None, **change):
    given = {"position": POINTS, "normal": UP} | change
    known = variables or {}, encoded
    return inference.shade_points(network, tiny.LIMITS, *known, **given)


def frame(variables=None, encoded=None, **change):
    given = FRAME | {"mask": np.ones((4, 5), bool)} | change
    known = variables or {}, encoded
    return image.shade_image(tiny.NETWORK, tiny.LIMITS, *known, **given)


def weights_of(network):
    example = partial(blank_example, network)
    init = partial(objective.init_variables, network, key=KEY)
    return jax.eval_shape(lambda: init(example()))


def codes(width, scale=None, around=None):
    """Of 20 points, with so many free features."""
    code = Code(np.zeros((20, width), np.float32), None)
    return Encoded(None, None, None, code, scale, around=around)


def training(**change):
    return replace(tiny.CONFIG, **change)


def network(**change):
    return replace(tiny.NETWORK, **change)


def conv(**change):
    return replace(tiny.NETWORK.query, **change)


def lit(**change):
    """Two channels of light and codes of two."""
    given = {"network": LIT, "material": None, "light": np.ones((2, 20, 1))}
    return encode(**given | change)


def lit_frame(**change):
    """A frame that f_2D sees the light of; its codes have two channels."""
    network = replace(LIT, asks="all")
    codes = Encoded(None, None, None, None, np.ones(2, np.float32))
    given = FRAME | {"mask": np.ones((4, 5), bool)} | change
    return image.shade_image(network, tiny.LIMITS, {}, codes, **given)


LIT = replace(tiny.NETWORK, lights=1)
MADE = replace(LIT, materials=1)
OWN, OTHERS = (weights_of(n) for n in (tiny.NETWORK, tiny.ONE_LEVEL))
OF_OTHERS = [
    ({}, "the weights are not this network's: give those"),
    ({"variables": OTHERS}, "the weights are not this network's: give those"),
]
CODES = [
    {"encoded": codes(2)},
    {"encoded": codes(4, scale=np.ones(1))},
    {"encoded": codes(4, around=())},
]
CODES_OF_OTHERS = [
    (given | {"variables": OWN}, "the codes are of another network: give")
    for given in CODES
]
OTHER = uniform_limits(presets.RELEASED, 64)

TABLE: Table = {
    encode: [
        ({"position": POINTS[:0], "normal": UP[:0]}, "the cloud is empty: sample"),
        ({"position": POINTS[:, :2]}, r"the cloud \(20, 2\) .* must both be"),
        ({"normal": UP[:5]}, r"normals \(5, 3\) must both be \[N, 3\]"),
        ({"position": WORDS}, "the cloud holds <U1: give real numbers"),
        ({"position": POINTS * NAN}, "the cloud holds non-finite"),
        ({"normal": UP * 0}, "normals are .* not of unit length"),
        ({"kept_before": np.zeros((2, 48), np.int8)}, r"kept_before is int8 \(2, 48\)"),
        ({"kept_before": np.zeros((2, 20), bool)}, r"bool \(2, 20\), not bool \(2, 48"),
        ({"light": np.ones((3, 20, 1))}, "the network takes no light: leave it out"),
        ({"network": LIT}, r"light is \(0,\), the network takes \[C 20 1\]"),
        (
            {"network": LIT, "light": np.ones((3, 5, 1))},
            "light is .3, 5, 1., the network takes",
        ),
        ({"network": LIT, "light": np.full((3, 20, 1), NAN)}, "light holds non-finite"),
        (
            {"network": LIT, "light": np.full((3, 20, 1), 1e39)},
            "light holds non-finite",
        ),
        (
            {"network": LIT, "light": -np.ones((3, 20, 1))},
            "light holds numbers below 0",
        ),
        ({"network": LIT, "light": np.ones((0, 20, 1))}, "light is .0, 20, 1., the"),
        ({"position": POINTS.astype(float) * 1e39}, "the cloud holds non-finite"),
        (
            {"position": POINTS.astype(float) * 3e38},
            r"the cloud .* beyond 1e\+18",
        ),
        ({"position": HALF * np.float16(INF)}, "the cloud holds non-finite"),
        ({"position": RAGGED}, "the cloud has rows of unequal length"),
        ({"normal": (127 * UP).astype(np.int8)}, "normals are .* not of unit length"),
        (
            {"network": LIT, "light": np.full((3, 20, 1), INF, np.float16)},
            "light holds non-finite",
        ),
        ({"limits": OTHER}, "the limits lack .*: they are of another network"),
        *OF_OTHERS,
    ],
    shade: [
        ({"position": POINTS[:, :2]}, r"points \(20, 2\) .* must both be"),
        ({"position": POINTS[:5]}, r"points \(5, 3\) and normals \(20, 3\)"),
        ({"position": POINTS * NAN}, "points holds non-finite"),
        ({"position": POINTS * np.float32(1e20)}, r"points .* beyond 1e\+18: scale"),
        ({"normal": UP * 3}, "normals are .* not of unit length"),
        ({"network": replace(LIT, asks="all")}, "light is .*, the network takes"),
        *OF_OTHERS,
        *CODES_OF_OTHERS,
    ],
    lit: [
        (
            {"network": MADE, "material": np.ones((3, 20, 1))},
            r"light, material and codes have \[2, 3\] channels: give all the same",
        ),
    ],
    lit_frame: [
        (
            {"light": np.ones((2, 5, 4, 1))},
            r"light \(2, 5, 4, 1\) does not fit the mask \(4, 5\): give",
        ),
        ({"light": np.ones((2, 20))}, r"light \(2, 20\) does not fit the mask"),
        ({"light": np.ones((3, 4, 5, 1))}, r"codes have \[2, 3\] channels"),
    ],
    frame: [
        ({"mask": np.ones((4, 5), int)}, r"mask is int64 \(4, 5\): give bool"),
        ({"mask": np.ones((2, 5), bool)}, r"do not fit the mask \(2, 5\)"),
        ({"normal": UP}, r"normal \(20, 3\) do not fit the mask"),
        ({"background": NAN}, "background nan must be"),
        ({"resolution_scale": 0.0}, "resolution scale 0.0: give 1 over a whole number"),
        ({"resolution_scale": NAN}, "resolution scale nan: give"),
        ({"resolution_scale": "half"}, "resolution scale holds <U4: give real"),
        ({"resolution_scale": [0.5]}, r"resolution scale \[0.5\]: give 1 over"),
        *OF_OTHERS,
        *CODES_OF_OTHERS,
    ],
    metrics.mse: [
        ((WORDS, WORDS), "holds <U1: give real numbers"),
        ((PICTURE * 1j, PICTURE), "holds complex128"),
        ((PICTURE, PICTURE[:3]), "shapes .* differ"),
        ((PICTURE, PICTURE, np.ones((12, 12), int)), "mask int64.* does not fit"),
        ((PICTURE * NAN, PICTURE), "values to compare are not finite"),
    ],
    metrics.equal_rays: [((1.0, INF), "equal rays of MSE 1.0, variance inf")],
    metrics.tone_map: [((PICTURE, PICTURE * NAN), "not finite")],
    presets.compact_network: [
        ({"k": 0}, "channels of conv_0 0 must be from 1"),
        ({"levels": (-1.0, 0.1)}, "level.* must be positive|radius .* positive"),
        ({"levels": (0.1, 0.05)}, r"levels \(0.1, 0.05\): give at least one, finest"),
        ({"query_radius": NAN}, "radius of query nan must be positive"),
        ({"latent": 0}, "channels of query 0 must be from 1"),
        ({"hidden": -1}, "hidden -1 must be from 1"),
        ({"norm": "none at all"}, "norm is 'none at all': give one of batch, layer"),
        ({"materials": 1.5}, "materials 1.5 must be"),
    ],
    network: [
        ({"encoder": (conv(skip="gone", target=0),)}, "skip of query is 'gone': give"),
        ({"encoder": (conv(target=7),)}, "target of query 7 must be from 0 to 1"),
        (
            {"query": conv(source=-2)},
            "query begins on level -2, where the table has come",
        ),
        ({"encoder": tiny.NETWORK.encoder[1:]}, "skip of up_1 is .conv_0.: give"),
        (
            {"encoder": tiny.NETWORK.encoder[1:2] * 2},
            "pool_1 begins on level 0, where the table has come to 1",
        ),
        ({"encoder": tiny.NETWORK.encoder[:1] * 2}, "two convolutions are called"),
        ({"levels": ("a", 0.1)}, "level holds <U1: give real numbers"),
        ({"query": conv(name="latent")}, "no convolution can be called latent: rename"),
        ({"query": conv(name="level_0")}, "no convolution can be called level_0"),
        ({"query": conv(name="query.x")}, "no convolution can be called query.x"),
        ({"local": True}, "a network without lights has none on a linear path"),
        ({"beams": 2}, "a network without lights has none on a linear path"),
        (
            {"lights": 1, "local": True, "query": conv(mixes=True)},
            "f_2D mixes, but light near a query passes it by itself",
        ),
        (
            {"encoder": tiny.NETWORK.encoder[:2], "query": conv(source=1)},
            "no convolution within level 1",
        ),
        (
            {"encoder": tiny.NETWORK.encoder[:3], "query": conv(source=1)},
            "let the encoder end there",
        ),
        ({"query": conv(target=0)}, "target of query 0 must be from -1 to -1"),
        ({"linear": True}, "networks that are linear .* take light"),
        ({"materials": 1}, "networks that .* take materials take light"),
        (
            {"lights": 1, "beams": 2, "query": conv(mixes=True)},
            "query mixes, but light passes it by itself",
        ),
    ],
    conv: [
        ({"bandwidth": 0.0}, "bandwidth of query 0.0 must be positive"),
        ({"before": "after"}, "before of query is 'after': give one of raw"),
    ],
    training: [
        ({"steps": 0}, "steps 0 must be from 1"),
        ({"batch_size": -2}, "batch_size -2 must be from 1"),
        ({"points": 1.5}, "points 1.5 must be"),
        ({"learning_rate": NAN}, "learning_rate nan must be positive"),
        ({"clip_norm": 0.0}, "clip_norm 0.0 must be positive"),
        ({"schedule": "none"}, "schedule is 'none': give one of cosine, paper"),
        ({"seed": -1}, "seed -1 must be from 0"),
    ],
}


@pytest.mark.parametrize("shape", [(0, 4), (4, 0)])
@pytest.mark.parametrize("scale", [1.0, 0.25])
def test_image_of_no_pixels_has_none(shape, scale):
    position, mask = np.zeros((*shape, 3), np.float32), np.ones(shape, bool)
    given = {"position": position, "normal": position, "mask": mask}
    given |= {"light": np.zeros((2, *shape, 1), np.float32), "resolution_scale": scale}
    assert lit_frame(**given)[0].shape == (*shape, 2)


@each_row(TABLE)
def test_bad_argument_is_refused_in_one_line(row, unchecked):
    assert_refused(row)

"""Arguments that cannot be meant: each refused in one line that names it.

`ROWS` is the table: what is called, with what in place of a good argument, and what is
said.
"""

from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest
import tiny
import trimesh

from ginn_jax import (
    architecture,
    camera,
    hierarchy,
    image,
    irradiance,
    lighting,
    lit_scenes,
    mesh,
    metrics,
    neighbors,
    objects,
    reference,
    shapes,
    slab,
    subsurface,
)
from ginn_jax.errors import InputError
from ginn_jax.geometry import uniform_limits

KEY = jax.random.key(0)
NAN, INF = float("nan"), float("inf")
POINTS = np.random.default_rng(0).uniform(size=(20, 3)).astype(np.float32)
UP = np.tile(np.float32([0, 1, 0]), (20, 1))
WORDS = np.array([["a", "b", "c"]] * 20)
RAGGED = [[1.0, 2, 3], [1.0, 2]]
SHAPE = trimesh.creation.box()
BOX = mesh.make_mesh(SHAPE.vertices, SHAPE.faces)
CLOUD = mesh.Samples(POINTS, UP, np.zeros(20, np.int32))
SKY = lighting.constant_sky()
LAMP = lighting.PointLight(np.ones(3), np.ones(3))
GREY = np.full((2, 3), 0.5)
MEDIUM = subsurface.Medium(np.full(3, 0.5), 1.0, 1.3)
ORIGIN, TARGET = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)
PICTURE = np.ones((12, 12))
FRAME = {"position": POINTS.reshape(4, 5, 3), "normal": UP.reshape(4, 5, 3)}


def disk(points, radius):
    return hierarchy.poisson_disk(points, radius, key=KEY)


def sample(shape=BOX, count=5, seed=0):
    return mesh.sample_surface(shape, count, seed=seed)


def ground(cloud=CLOUD, half_extent=0.8, seed=0):
    return mesh.add_ground_samples(cloud, half_extent, seed=seed)


def occlusion(**change):
    given = {"mesh": BOX, "points": POINTS, "normals": UP, "radius": 0.1}
    return reference.ambient_occlusion(**(given | {"rays": 4, "seed": 0} | change))


def view(**change):
    return camera.Camera(**({"origin": ORIGIN, "target": TARGET} | change))


def lit(albedo=GREY, light=SKY, **change):
    return irradiance.light_scene(BOX._replace(**change), albedo, light)


@cache
def scene():
    return lit()


def direct(**change):
    given = {"points": POINTS, "normals": UP, "samples": 2, "seed": 0} | change
    return irradiance.direct_irradiance(scene(), **given)


def indirect(**change):
    given = {"points": POINTS, "normals": UP, "paths": 2, "seed": 0} | change
    return irradiance.indirect_irradiance(scene(), **given)


def exitance(paths=1, **change):
    medium = MEDIUM._replace(**change)
    return subsurface.subsurface_exitance(
        scene(), medium, POINTS, UP, paths=paths, seed=0
    )


def encode(network=tiny.NETWORK, limits=tiny.LIMITS, **change):
    """Nothing is computed: what is wrong is said before."""
    given = {"position": POINTS, "normal": UP, "key": KEY} | change
    return image.encode_cloud(network, limits, {}, **given)


def shade(network=tiny.NETWORK, **change):
    given = {"position": POINTS, "normal": UP} | change
    return image.shade_points(network, tiny.LIMITS, {}, None, **given)


def frame(**change):
    given = FRAME | {"mask": np.ones((4, 5), bool)} | change
    return image.shade_image(tiny.NETWORK, tiny.LIMITS, {}, None, **given)


def training(**change):
    return replace(tiny.CONFIG, **change)


def network(**change):
    return replace(tiny.NETWORK, **change)


def conv(**change):
    return replace(tiny.NETWORK.query, **change)


LIT = replace(tiny.NETWORK, lights=1)
OTHER = uniform_limits(architecture.RELEASED, 64)


class Row(NamedTuple):
    """What is called, with what, what is said."""

    call: Any
    given: Any
    message: str


# For each function: what it is told, by name or in order, and what it says to that.
TABLE: dict[Any, list[tuple[Any, str]]] = {
    neighbors.find_neighbors: [
        ((POINTS[:, :2], POINTS, 0.1), r"points has shape \(20, 2\): give"),
        ((POINTS, POINTS[0], 0.1), r"queries has shape \(3,\): give"),
        ((WORDS, POINTS, 0.1), "points holds <U1: give real numbers"),
        ((POINTS * 1j, POINTS, 0.1), "points holds complex64: give real"),
        ((np.full((4, 3), None), POINTS, 0.1), "points holds object: give real"),
        ((RAGGED, POINTS, 0.1), "points has rows of unequal length"),
        ((POINTS, POINTS * NAN, 0.1), "queries holds non-finite .*: remove"),
        ((POINTS * np.float32(1e20), POINTS, 0.1), r"points .* beyond 1e\+18: scale"),
        ((POINTS, POINTS, -1.0), "radius is -1.0: give a number above 0"),
        ((POINTS, POINTS, NAN), "radius is nan: give"),
        ((POINTS, POINTS, 1e300), r"radius is 1e\+300: give"),
        ((POINTS, POINTS, 1e-30), "radius is 1e-30: give"),
        ((POINTS, POINTS, "wide"), "radius holds <U4: give real numbers"),
    ],
    disk: [
        ((POINTS, 0.0), "radius is 0.0: give"),
        ((POINTS, np.ones(3)), r"radius is \[1. 1. 1.\]: give"),
        ((POINTS[:, :2], 0.1), "points has shape"),
        ((POINTS * INF, 0.1), "points holds non-finite"),
    ],
    mesh.make_mesh: [
        ((WORDS, [[0, 1, 2]]), "vertices holds <U1: give real numbers"),
        ((RAGGED, [[0, 1, 2]]), "vertices has rows of unequal length"),
        ((np.eye(3), [[0, 1, 2]], [-1]), r"a material is outside 0..255; mend"),
        ((np.eye(3), [[0, 1, 2]], [NAN]), r"a material is outside 0..255; mend"),
        ((np.eye(3), [[0, 1, 2]], ["red"]), "material holds <U3"),
    ],
    mesh.fit_unit_box: [
        ((BOX._replace(vertices=BOX.vertices * NAN),), "object: empty or not finite"),
        ((BOX._replace(vertices=BOX.vertices * 0),), "object: all points coincide"),
    ],
    mesh.add_ground: [
        ((BOX, -1.0), "half_extent -1.0 must be positive"),
        ((BOX, NAN), "half_extent nan must be positive"),
    ],
    sample: [
        ((BOX, -1), "count -1 must be from 0"),
        ((BOX, 1.5), "count 1.5 must be .* a whole number"),
        ((BOX, NAN), "count nan must be"),
        ((BOX, 10**13), "count 10000000000000 must be"),
        ((BOX._replace(faces=BOX.faces[:0]), 5), "mesh: empty; give vertices"),
        ((BOX._replace(faces=BOX.faces + 9), 5), r"face index is outside 0\.\.7"),
        ((BOX._replace(vertices=BOX.vertices * NAN), 5), "8 vertices are not finite"),
        ((BOX._replace(vertices=BOX.vertices * 0), 5), "all faces have zero area"),
        (("chair.obj", 5), "mesh is a str: give what load_mesh"),
        ({"seed": -1}, "seed -1 must be from 0"),
    ],
    ground: [
        ((CLOUD, -1.0), "half_extent -1.0 must be positive"),
        ((CLOUD, 1e9), "half_extent 1000000000.0 takes .* points: lower"),
        ((CLOUD._replace(position=POINTS * NAN),), "points holds non-finite"),
        ((CLOUD._replace(position=POINTS[:, :2]),), r"must both be \[N, 3\]"),
        ((CLOUD._replace(normal=UP * 0),), "normals are .* not of unit length"),
    ],
    occlusion: [
        ({"radius": -1.0}, "radius -1.0 must be positive"),
        ({"radius": NAN}, "radius nan must be positive"),
        ({"rays": 1.5}, "rays 1.5 must be from 1"),
        ({"rays": 2**40}, "rays 1099511627776 must be from 1"),
        ({"seed": 0.5}, "seed 0.5 must be"),
        ({"points": WORDS}, "points holds <U1: give real numbers"),
        ({"normals": UP * 2}, "normals are .* not of unit length: divide"),
        ({"mesh": None}, "mesh is a NoneType: give"),
        ({"mesh": BOX._replace(vertices=BOX.vertices[:, :2])}, "mesh: wrong shape"),
        ({"mesh": BOX._replace(faces=BOX.faces + 0.5)}, "mesh: wrong shape"),
        ({"mesh": BOX._replace(material=BOX.material[:1])}, "one material a face"),
    ],
    view: [
        ({"width": 0}, "camera's width 0 must be from 1"),
        (
            {"width": 10**6, "height": 10**6},
            "camera's height 1000000 must be",
        ),
        ({"height": 1.5}, "camera's height 1.5 must be .* whole"),
        ({"vertical_fov": NAN}, "camera's vertical_fov nan must be a number"),
        ({"origin": (0.0, 1.0)}, r"camera's origin \(0.0, 1.0\) must be three"),
        ({"origin": "abc"}, "camera's origin holds <U3: give real numbers"),
        ({"up": (0.0, 0.0, 1.0)}, "camera looks along its up"),
    ],
    camera.orbit_camera: [
        ({"azimuth": INF}, "azimuth inf must be a number"),
        ({"elevation": 90.0}, "elevation 90.0 looks along up: stay inside"),
        ({"distance": -1.0}, "distance -1.0 must be positive"),
    ],
    lighting.constant_sky: [
        ((-1.0,), "radiance -1.0 must be a number from 0"),
        ((NAN,), "radiance nan must be"),
        ((1e39,), r"radiance 1e\+39 must be"),
    ],
    lighting.sun_and_sky: [
        ((0.5, np.array([0, 1, 0.0])), "turbidity 0.5 must be a number from 1 to 10"),
        ((NAN, np.array([0, 1, 0.0])), "turbidity nan must be"),
        ((3.0, np.zeros(3)), "direction .* below the horizon or zero: lift"),
        ((3.0, np.array([0, -1, 0.0])), "direction .* below the horizon"),
        ((3.0, np.array([0, 1.0])), "direction .* must be three finite numbers"),
        ((3.0, np.array([0, 1, 0.0]), -1.0), "sun_scale -1.0 must be"),
        ((3.0, np.array([0, 1, 0.0]), INF), "sun_scale inf must be"),
    ],
    lighting.make_environment: [
        ((np.full((2, 4, 3), "a"),), "radiance holds <U1"),
        ((np.full((2, 4, 3), 1e39),), "radiance is not finite"),
        ((np.ones((2, 4)),), r"map is \[H W 3\], this is \(2, 4\)"),
    ],
    lighting.studio: [((-1,), "seed -1 must be"), ((1.5,), "seed 1.5 must be")],
    lighting.procedural_environment: [((-1,), "seed -1 must be")],
    lighting.turned: [((SKY, NAN), "share nan must be")],
    lit: [
        ({"albedo": GREY * 3}, "an albedo above 1 would make light"),
        ({"albedo": -GREY}, "albedo .* not negative"),
        ({"albedo": np.full((2, 3), "a")}, "albedo holds <U1"),
        ({"light": None}, "light is a NoneType: give an EnvironmentMap or"),
        ({"light": lighting.EnvironmentMap(np.ones((0, 0, 3)))}, "this is .0, 0, 3"),
        ({"light": lighting.EnvironmentMap(np.full((4, 8, 3), NAN))}, "not finite"),
        ({"light": lighting.EnvironmentMap(-np.ones((4, 8, 3)))}, "negative; clip"),
        ({"light": LAMP._replace(position=np.full(3, NAN))}, "light's position .nan"),
        ({"light": LAMP._replace(intensity=-np.ones(3))}, "light's intensity .* neg"),
        ({"light": LAMP._replace(position=np.ones(2))}, "light's position .* three"),
        ({"vertices": BOX.vertices * NAN}, "8 vertices are not finite"),
        ({"material": BOX.material - 1}, r"a material is outside 0\.\.255"),
    ],
    direct: [
        ({"samples": 0}, "samples 0 must be from 1"),
        ({"samples": 1.5}, "samples 1.5 must be"),
        ({"seed": -1}, "seed -1 must be"),
    ],
    indirect: [
        ({"paths": -4}, "paths -4 must be from 1"),
        ({"paths": NAN}, "paths nan must be"),
        ({"points": POINTS * INF}, "points holds non-finite"),
    ],
    exitance: [
        ({"albedo": np.full(3, 1.5)}, r"albedo .* must be three numbers in \[0, 1\]"),
        ({"albedo": np.array(["a"] * 3)}, "albedo holds <U1"),
        ({"extinction": -1.0}, "extinction -1.0 must be a number from 0"),
        ({"extinction": np.ones(3)}, "extinction .* must be a number"),
        ({"ior": 0.9}, "index of refraction 0.9 must be a number from 1 to 2"),
        ({"ior": NAN}, "index of refraction nan must be"),
        ({"paths": -1}, "paths -1 must be from 1"),
    ],
    slab.single_scattering_albedo: [
        ((np.full(3, 0.5), 0.5), "index of refraction 0.5 must be"),
        ((np.full(3, NAN), 1.3), "albedo .* is not finite"),
    ],
    lit_scenes.Illumination: [({"targets": 0}, "targets 0 must be from 1 to 20000")],
    lit_scenes.Scattering: [
        ({"size": NAN}, "size nan must be positive"),
        ({"absorption": 0.0}, "absorption 0.0 must be positive"),
        ({"targets": 30_000}, "targets 30000 must be from 1 to 20000"),
    ],
    encode: [
        ({"position": POINTS[:0]}, "the cloud is empty: sample"),
        ({"position": POINTS[:, :2]}, r"the cloud \(20, 2\) .* must both be"),
        ({"normal": UP[:5]}, r"normals \(5, 3\) must both be \[N, 3\]"),
        ({"position": WORDS}, "the cloud holds <U1: give real numbers"),
        ({"position": POINTS * NAN}, "the cloud holds non-finite"),
        ({"normal": UP * 0}, "normals are .* not of unit length"),
        ({"light": np.ones((3, 20, 1))}, "the network takes no light: leave it out"),
        ({"network": LIT}, r"light is \(0,\), the network takes \[C 20 1\]"),
        ({"network": LIT, "light": np.ones((3, 5, 1))}, "light is .3, 5, 1., the net"),
        ({"network": LIT, "light": np.full((3, 20, 1), NAN)}, "light holds non-finite"),
        ({"limits": OTHER}, "the limits lack .*: they are of another network"),
    ],
    shade: [
        ({"position": POINTS[:, :2]}, r"points \(20, 2\) .* must both be"),
        ({"position": POINTS[:5]}, r"points \(5, 3\) and normals \(20, 3\)"),
        ({"position": POINTS * NAN}, "points holds non-finite"),
        ({"normal": UP * 3}, "normals are .* not of unit length"),
        ({"network": replace(LIT, asks="all")}, "light is .*, the network takes"),
    ],
    frame: [
        ({"mask": np.ones((4, 5), int)}, r"mask is int64 \(4, 5\): give bool"),
        ({"mask": np.ones((2, 5), bool)}, r"do not fit the mask \(2, 5\)"),
        ({"normal": UP}, r"normal \(20, 3\) do not fit the mask"),
        ({"background": NAN}, "background nan must be"),
        ({"resolution_scale": 0.0}, r"resolution scale 0.0: give it in \(0, 1\]"),
        ({"resolution_scale": NAN}, "resolution scale nan: give"),
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
    architecture.compact_network: [
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
        ({"query": conv(source=-2)}, "source of query -2 must be from 0 to 1"),
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
    shapes.random_shape: [((-1,), "seed -1 must be"), ((1.5,), "seed 1.5 must be")],
    objects.pair_up: [
        (([], [], 1), "no lights: give environment maps"),
        (([], objects.point_lights(2, 0), 0), "lights for each object 0 must be"),
    ],
}
ROWS = [Row(call, given, said) for call, rows in TABLE.items() for given, said in rows]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: f"{row.message[:30]}")
def test_bad_argument_is_refused_in_one_line(row, unchecked):
    named = isinstance(row.given, dict)
    names, rest = (row.given, ()) if named else ({}, row.given)
    with pytest.raises(InputError, match=row.message) as caught:
        row.call(*rest, **names)
    assert str(caught.value).isprintable()

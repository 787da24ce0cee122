"""Points, meshes, cameras and counts of rays that cannot be meant.

Each refused in one line that names the argument.
"""

import numpy as np
from refusals import (
    BOX,
    INF,
    KEY,
    NAN,
    PLACES,
    POINTS,
    RAGGED,
    UP,
    WORDS,
    Table,
    assert_refused,
    each_row,
)

from ginn_jax import (
    camera,
    hierarchy,
    mesh,
    neighbors,
    reference,
    samples,
    scenes,
    sequences,
    shapes,
    visible,
)

CLOUD = samples.Samples(POINTS, UP, np.zeros(20, np.int32))
SHOT = sequences.Animation(BOX.vertices[None], BOX.faces)
ORIGIN, TARGET = (0.0, 0.0, 1.0), (0.0, 0.0, 0.0)


def disk(points, radius):
    return hierarchy.poisson_disk(points, radius, key=KEY)


def sample(shape=BOX, count=5, seed=0):
    return samples.sample_surface(shape, count, seed=seed)


def ground(cloud=CLOUD, half_extent=0.8, seed=0):
    return samples.add_ground_samples(cloud, half_extent, seed=seed)


def occlusion(**change):
    given = {"mesh": BOX, "points": POINTS, "normals": UP, "radius": 0.1}
    return reference.ambient_occlusion(**(given | {"rays": 4, "seed": 0} | change))


def seen(count):
    return visible.visible_samples(reference.build_scene(BOX), count, 0)


def carried(count=5, seed=0):
    return sequences.carried_samples(BOX, count, seed=seed)


def view(**change):
    return camera.Camera(**({"origin": ORIGIN, "target": TARGET} | change))


TABLE: Table = {
    neighbors.find_neighbors: [
        ((POINTS[:, :2], POINTS, 0.1), r"points has shape \(20, 2\): give"),
        ((POINTS[:4].T, POINTS, 0.1), r"points has shape \(3, 4\): give"),
        ((POINTS[None], POINTS, 0.1), r"points has shape \(1, 20, 3\): give"),
        ((0.5, POINTS, 0.1), r"points has shape \(\): give"),
        ((POINTS, POINTS[0], 0.1), r"queries has shape \(3,\): give"),
        ((WORDS, POINTS, 0.1), "points holds <U1: give real numbers"),
        ((POINTS * 1j, POINTS, 0.1), "points holds complex64: give real"),
        ((np.full((4, 3), None), POINTS, 0.1), "points holds object: give real"),
        ((RAGGED, POINTS, 0.1), "points has rows of unequal length"),
        ((POINTS, POINTS * NAN, 0.1), "queries holds non-finite .*: remove"),
        ((np.diag([0, NAN, 0]), POINTS, 0.1), "points holds non-finite"),
        ((np.diag([0, INF, 0]), POINTS, 0.1), "points holds non-finite"),
        ((np.diag([0, -INF, 0]), POINTS, 0.1), "points holds non-finite"),
        ((POINTS * np.float32(1e20), POINTS, 0.1), r"points .* beyond 1e\+18: scale"),
        ((POINTS, POINTS, -1.0), "radius is -1.0: give a number above 0"),
        ((POINTS, POINTS, 0.0), "radius is 0.0: give"),
        ((POINTS, POINTS, NAN), "radius is nan: give"),
        ((POINTS, POINTS, INF), "radius is inf: give"),
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
        ((np.zeros((0, 3)), np.zeros((0, 3), int)), "mesh: empty; give vertices"),
        ((np.eye(3), np.zeros((0, 3), int)), "mesh: empty; give vertices"),
        ((np.eye(2), [[0, 1, 1]]), "mesh: wrong shape; give vertices"),
        ((np.eye(3), [[0.5, 1.5, 2.5]]), "mesh: wrong shape; give vertices"),
        ((np.eye(3) * [NAN, 1, 1], [[0, 1, 2]]), "mesh: 3 vertices are not finite"),
        ((np.diag([1, 1, 1e300]), [[0, 1, 2]]), "mesh: 1 vertices are not finite"),
        ((np.eye(3), [[0, 1, 3]]), r"mesh: a face index is outside 0\.\.2"),
        ((np.eye(3), [[0, 1, -1]]), r"mesh: a face index is outside 0\.\.2"),
        ((np.eye(3), [[0, 1, 1]]), "mesh: all faces have zero area"),
        (
            (np.eye(3), [[0, 1, 2]], np.zeros(2)),
            "mesh: give one material a face, 1 in all",
        ),
        ((WORDS, [[0, 1, 2]]), "vertices holds <U1: give real numbers"),
        ((RAGGED, [[0, 1, 2]]), "vertices has rows of unequal length"),
        ((np.eye(3), [[0, 1, 2]], [-1]), r"a material is outside 0..255; mend"),
        ((np.eye(3), [[0, 1, 2]], [NAN]), r"a material is outside 0..255; mend"),
        ((np.eye(3), [[0, 1, 2]], [0.7]), "a material is no whole number; mend"),
        ((np.eye(3), [[0, 1, 2]], ["red"]), "material holds <U3"),
    ],
    mesh.fit_unit_box: [
        ((BOX._replace(vertices=BOX.vertices * NAN),), "object: empty or not finite"),
        ((BOX._replace(vertices=BOX.vertices * 0),), "object: all points coincide"),
    ],
    samples.fit_unit_box_points: [
        ((CLOUD._replace(position=POINTS * 0),), "object: all points coincide"),
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
        (
            (samples.Samples(*(a[:8] for a in CLOUD)),),
            "point cloud: fewer than 9 points",
        ),
        ((CLOUD, 1e9), "half_extent 1000000000.0 takes .* points: lower"),
        ((CLOUD._replace(position=POINTS * NAN),), "points holds non-finite"),
        ((CLOUD._replace(position=POINTS[:, :2]),), r"must both be \[N, 3\]"),
        ((CLOUD._replace(normal=UP * 0),), "normals are .* not of unit length"),
    ],
    occlusion: [
        ({"radius": 1e-6}, "radius 1e-06 is too short for coordinates up to"),
        *PLACES,
        ({"radius": -1.0}, "radius -1.0 must be positive"),
        ({"radius": 0.0}, "radius 0.0 must be positive"),
        ({"radius": NAN}, "radius nan must be positive"),
        ({"radius": INF}, "radius inf must be positive"),
        ({"rays": 0}, "rays 0 must be from 1"),
        ({"rays": 1.5}, "rays 1.5 must be from 1"),
        ({"rays": 2**40}, "rays 1099511627776 must be from 1"),
        ({"seed": -1}, "seed -1 must be from 0"),
        ({"seed": 0.5}, "seed 0.5 must be"),
        ({"points": WORDS}, "points holds <U1: give real numbers"),
        ({"mesh": None}, "mesh is a NoneType: give"),
        ({"mesh": BOX._replace(faces=BOX.faces[:0])}, "mesh: empty; give vertices"),
        ({"mesh": BOX._replace(faces=BOX.faces + 1)}, r"face index is outside 0\.\.7"),
        (
            {"mesh": BOX._replace(vertices=BOX.vertices * NAN)},
            "8 vertices are not finite",
        ),
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
        ({"height": -1}, "camera's height -1 must be from 1"),
        ({"height": 1.5}, "camera's height 1.5 must be .* whole"),
        ({"vertical_fov": NAN}, "camera's vertical_fov nan must be a number"),
        ({"vertical_fov": 0.0}, r"camera's vertical_fov 0.0 must be inside \(0, 180\)"),
        ({"vertical_fov": 180.0}, "camera's vertical_fov 180.0 must be inside"),
        ({"origin": TARGET}, "camera looks along its up, or nowhere: move"),
        ({"origin": (0.0, 1.0, 0.0)}, "camera looks along its up"),
        ({"origin": (0.0, 0.0, NAN)}, "camera's origin .* must be three finite"),
        ({"up": (0.0, 0.0, 0.0)}, "camera looks along its up"),
        ({"origin": (0.0, 1.0)}, r"camera's origin \(0.0, 1.0\) must be three"),
        ({"origin": "abc"}, "camera's origin holds <U3: give real numbers"),
        ({"up": (0.0, 0.0, 1.0)}, "camera looks along its up"),
    ],
    camera.orbit_camera: [
        ({"azimuth": INF}, "azimuth inf must be a number"),
        ({"elevation": 90.0}, "elevation 90.0 looks along up: stay inside"),
        ({"distance": -1.0}, "distance -1.0 must be positive"),
        ({"distance": 0.0}, "distance 0.0 must be positive"),
    ],
    seen: [
        ({"count": -5}, "count -5 must be from 0"),
        ({"count": 1.5}, "count 1.5 must be .* whole"),
    ],
    carried: [
        ({"count": -5}, "count -5 must be from 0"),
        ({"count": 1.5}, "count 1.5 must be .* whole"),
        ({"seed": -1}, "seed -1 must be from 0"),
    ],
    sequences.procedural_animation: [
        ((0, 0), "frames 0 must be from 1"),
        ((0, 1.5), "frames 1.5 must be .* whole"),
    ],
    sequences.frames_of: [
        ((SHOT, -1, True), "count -1 must be from 1"),
        ((SHOT._replace(vertices=SHOT.vertices[:0]), 1, True), "animation: no frames"),
    ],
    scenes.Occlusion: [
        ({"points": -5}, "points -5 must be from 1"),
        ({"rays": 0}, "rays 0 must be from 1"),
        ({"radius": NAN}, "radius nan must be positive"),
    ],
    shapes.random_shape: [((-1,), "seed -1 must be"), ((1.5,), "seed 1.5 must be")],
}


@each_row(TABLE)
def test_bad_argument_is_refused_in_one_line(row, unchecked):
    assert_refused(row)

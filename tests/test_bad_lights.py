"""Lights, media and counts of paths that cannot be meant.

Each refused in one line that names the argument.
"""

from functools import cache

import numpy as np
from refusals import BOX, INF, NAN, PLACES, POINTS, UP, Table, assert_refused, each_row

from ginn_jax import (
    estimates,
    irradiance,
    lighting,
    lit_scenes,
    objects,
    pairing,
    slab,
    subsurface,
)

SKY = lighting.constant_sky()
LAMP = lighting.PointLight(np.ones(3), np.ones(3))
GREY = np.full((2, 3), 0.5)
MOST = estimates.PATHS_PER_LAUNCH
MEDIUM = subsurface.Medium(np.full(3, 0.5), 1.0, 1.3)


def lit(albedo=GREY, light=SKY, **change):
    return irradiance.light_scene(BOX._replace(**change), albedo, light)


@cache
def scene():
    return lit()


def direct(**change):
    given = {"points": POINTS, "normals": UP, "looks": 2, "seed": 0} | change
    return irradiance.direct_irradiance(scene(), **given)


def indirect(**change):
    given = {"points": POINTS, "normals": UP, "paths": 2, "seed": 0} | change
    return irradiance.indirect_irradiance(scene(), **given)


def exitance(points=POINTS, normals=UP, paths=1, seed=0, material=0, **change):
    mesh = BOX._replace(material=BOX.material + material)
    ends = scene()._replace(mesh=mesh), MEDIUM._replace(**change), points, normals
    return subsurface.subsurface_exitance(*ends, paths=paths, seed=seed)


def drawn(seed):
    return lit_scenes.light_mesh(BOX, SKY, lit_scenes.Illumination(), seed=seed)


TABLE: Table = {
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
        ((np.full((2, 4, 3), INF, np.float16),), "radiance is not finite"),
        ((np.full((2, 4, 3), 1e-60),), "radiance is zero everywhere"),
        ((np.ones((2, 4)),), r"map is \[H W 3\], this is \(2, 4\)"),
        ((np.ones((4, 8, 4)),), r"map is \[H W 3\], this is \(4, 8, 4\)"),
        ((np.ones((0, 0, 3)),), r"map is \[H W 3\], this is \(0, 0, 3\)"),
        ((np.ones((4, 0, 3)),), r"map is \[H W 3\], this is \(4, 0, 3\)"),
    ],
    lighting.studio: [((-1,), "seed -1 must be"), ((1.5,), "seed 1.5 must be")],
    lighting.procedural_environment: [((-1,), "seed -1 must be")],
    lighting.turned: [((SKY, NAN), "share nan must be")],
    lighting.irradiance_of: [
        ((lighting.EnvironmentMap(np.ones((8, 8, 3))), UP[0]), "twice as wide as high"),
    ],
    lit: [
        ({"albedo": np.full((2, 3), 1.001)}, "an albedo above 1 would make light"),
        ({"albedo": GREY * INF}, "an albedo above 1 would make light"),
        ({"albedo": np.full((2, 3), -0.001)}, "albedo .* not negative"),
        ({"albedo": GREY * NAN}, "albedo .* not negative"),
        ({"albedo": GREY[0]}, r"albedo \(3,\) must be \[K 3\]"),
        ({"albedo": np.full((2, 4), 0.5)}, r"albedo \(2, 4\) must be \[K 3\]"),
        ({"albedo": GREY[:0]}, "0 albedos for materials up to 0: give all"),
        (
            {"albedo": GREY[:1], "material": BOX.material + 1},
            "1 albedos for materials up to 1: give all",
        ),
        ({"albedo": np.full((2, 3), "a")}, "albedo holds <U1"),
        ({"light": None}, "light is a NoneType: give an EnvironmentMap or"),
        ({"light": lighting.EnvironmentMap(np.ones((0, 0, 3)))}, "this is .0, 0, 3"),
        ({"light": lighting.EnvironmentMap(np.full((4, 8, 3), NAN))}, "not finite"),
        ({"light": lighting.EnvironmentMap(-np.ones((4, 8, 3)))}, "negative; clip it"),
        ({"light": LAMP._replace(position=np.full(3, NAN))}, "light's position .nan"),
        (
            {"light": LAMP._replace(intensity=-np.ones(3))},
            "light's intensity .* is negative",
        ),
        ({"light": LAMP._replace(position=np.ones(2))}, "light's position .* three"),
        ({"light": LAMP._replace(intensity=np.full(3, 1e39))}, "intensity .* finite"),
        ({"vertices": BOX.vertices * NAN}, "8 vertices are not finite"),
        ({"material": BOX.material - 1}, r"a material is outside 0\.\.255"),
    ],
    direct: [
        *PLACES,
        ({"looks": 0}, "looks 0 must be from 1"),
        ({"looks": -3}, "looks -3 must be from 1"),
        ({"looks": 1.5}, "looks 1.5 must be"),
        ({"looks": MOST + 1}, "looks 4194305 must be from 1 to 4194304"),
        ({"seed": -1}, "seed -1 must be"),
        ({"seed": 2**32}, "seed 4294967296 must be from 0 to 4294967295"),
    ],
    indirect: [
        *PLACES,
        ({"paths": 0}, "paths 0 must be from 1"),
        ({"paths": -4}, "paths -4 must be from 1"),
        ({"paths": NAN}, "paths nan must be"),
        ({"paths": MOST + 1}, "paths 4194305 must be from 1 to 4194304"),
        ({"points": POINTS * INF}, "points holds non-finite"),
        ({"seed": -1}, "seed -1 must be"),
        ({"seed": 2**32}, "seed 4294967296 must be from 0 to 4294967295"),
    ],
    exitance: [
        *PLACES,
        ({"albedo": np.array([0.5, 0.5, 1.1])}, r"albedo .* three numbers in \[0, 1\]"),
        ({"albedo": np.array([0.5, -0.1, 0.5])}, "albedo .* must be three numbers in"),
        ({"albedo": np.array([0.5, NAN, 0.5])}, "albedo .* must be three numbers in"),
        ({"albedo": np.array(["a"] * 3)}, "albedo holds <U1"),
        ({"extinction": -1.0}, "extinction -1.0 must be a number from 0"),
        ({"extinction": INF}, "extinction inf must be a number from 0"),
        ({"extinction": NAN}, "extinction nan must be a number from 0"),
        ({"extinction": np.ones(3)}, "extinction .* must be a number"),
        ({"ior": 0.9}, "index of refraction 0.9 must be a number from 1 to 2"),
        ({"ior": 2.1}, "index of refraction 2.1 must be a number from 1 to 2"),
        ({"ior": NAN}, "index of refraction nan must be"),
        ({"paths": 0}, "paths 0 must be from 1"),
        ({"paths": -1}, "paths -1 must be from 1"),
        ({"seed": -1}, "seed -1 must be"),
        ({"material": 1}, "no face of material 0 to enclose a medium"),
    ],
    slab.single_scattering_albedo: [
        ((np.full(3, 0.5), 0.5), "index of refraction 0.5 must be"),
        ((np.full(3, NAN), 1.3), "albedo .* is not finite"),
    ],
    lit_scenes.Illumination: [
        ({"targets": 0}, "targets 0 must be from 1 to 20000"),
        ({"points": -5}, "points -5 must be from 1"),
        ({"paths": 0}, "paths 0 must be from 1"),
        ({"looks": 1.5}, "looks 1.5 must be .* whole"),
    ],
    lit_scenes.draw_albedo: [((-1,), "seed -1 must be from 0")],
    lit_scenes.draw_medium: [
        ((GREY[0], -1, lit_scenes.Scattering()), "seed -1 must be from 0"),
    ],
    drawn: [((-1,), "seed -1 must be from 0")],
    objects.random_point_light: [((-1,), "seed -1 must be from 0")],
    objects.load_light: [
        (
            (objects.Source("box", None, -1, objects.LightSource("a", "a.hdr", 0)),),
            "seed -1 must be from 0",
        ),
    ],
    lit_scenes.Scattering: [
        ({"size": NAN}, "size nan must be positive"),
        ({"absorption": 0.0}, "absorption 0.0 must be positive"),
        ({"targets": 30_000}, "targets 30000 must be from 1 to 20000"),
    ],
    pairing.split_apart: [
        (([1, 2], [1], -1), "seed -1 must be from 0"),
        (([1, 2], [-1], 0), "count -1 must be from 0"),
    ],
    pairing.mixed: [(([], [1, 2], 2, -1), "seed -1 must be from 0")],
    pairing.pair_up: [
        (([], [], 1), "no lights: give environment maps"),
        (([], objects.point_lights(2, 0), 0), "lights for each object 0 must be"),
    ],
}


@each_row(TABLE)
def test_bad_argument_is_refused_in_one_line(row, unchecked):
    assert_refused(row)

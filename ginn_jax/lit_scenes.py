"""Scenes with materials and a light, and the light transport that networks learn.

Two effects: global illumination, of a diffuse object on diffuse ground, and subsurface
scattering, of a translucent object in the air.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ginn_jax.checks import LARGEST_SEED, positive, whole
from ginn_jax.errors import warn
from ginn_jax.estimates import PATHS_PER_LAUNCH, ColorEstimate
from ginn_jax.irradiance import (
    LitScene,
    direct_irradiance,
    indirect_irradiance,
    light_scene,
)
from ginn_jax.lighting import Light
from ginn_jax.lit_clouds import DENSE, LitCloud
from ginn_jax.mesh import Mesh
from ginn_jax.objects import Source, load_light, load_object
from ginn_jax.reference import build_scene
from ginn_jax.samples import Samples
from ginn_jax.slab import single_scattering_albedo
from ginn_jax.subsurface import Medium, subsurface_exitance
from ginn_jax.visible import MOST_SAMPLES, visible_samples

# The share of lost walks from which on a mesh is said not to hold its medium.
MOST_LOST = 0.05


@dataclass(frozen=True)
class Illumination:
    """What makes the ground truth of global illumination.

    points    samples of the surface
    paths     paths per sample
    looks     directions of the light per sample
    targets   how many samples, the last ones, have a target (None: all)
    """

    points: int = 20_000
    paths: int = 32
    looks: int = 128
    targets: int | None = None

    def __post_init__(self) -> None:
        _check_counts(self)


@dataclass(frozen=True)
class Scattering:
    """What makes the ground truth of subsurface scattering; `Illumination` has more.

    The object's longest side measures `size` mm, and its medium's reduced absorption
    coefficient is drawn from an exponential distribution of mean `absorption` per mm
    (paper, section "Training Data Generation"), kept between 1/10 and 5 times that.
    """

    points: int = 20_000
    paths: int = 32
    looks: int = 128
    targets: int | None = None
    size: float = 100.0
    absorption: float = 0.1

    def __post_init__(self) -> None:
        _check_counts(self)
        positive("size", self.size)
        positive("absorption", self.absorption)


def _check_counts(settings: Illumination | Scattering) -> None:
    whole("points", settings.points, 1, MOST_SAMPLES)
    whole("paths", settings.paths, 1, PATHS_PER_LAUNCH)
    whole("looks", settings.looks, 1, PATHS_PER_LAUNCH)
    if settings.targets is not None:
        whole("targets", settings.targets, 1, settings.points)


class Lit(NamedTuple):
    """A scene ready for rays, the albedo of its materials, and the medium if any."""

    scene: LitScene
    albedo: Float[np.ndarray, "K 3"]
    medium: Float[np.ndarray, "P"]


def light_up(source: Source, settings: Illumination | Scattering) -> Lit:
    """The scene of a source; its materials are drawn by its seed."""
    mesh = load_object(source, ground=isinstance(settings, Illumination))
    return light_mesh(mesh, load_light(source), settings, seed=source.seed)


def light_mesh(
    mesh: Mesh, light: Light, settings: Illumination | Scattering, *, seed: int
) -> Lit:
    """The scene of a mesh, with its ground if any; materials are drawn by the seed."""
    scatters = isinstance(settings, Scattering)
    albedo = draw_albedo(seed)[: 1 if scatters else 2]
    medium = draw_medium(albedo[0], seed, settings) if scatters else np.zeros(0)
    return Lit(light_scene(mesh, albedo, light), albedo, medium)


def draw_albedo(seed: int) -> Float[np.ndarray, "2 3"]:
    """Uniform RGB albedos of object and ground."""
    rng = np.random.default_rng((whole("seed", seed, 0, LARGEST_SEED), 4))
    return rng.uniform(0, 1, (2, 3)).astype(np.float32)


def draw_medium(
    albedo: Float[np.ndarray, "3"], seed: int, settings: Scattering
) -> Float[np.ndarray, "2"]:
    """Extinction per length of the object, and index of refraction.

    The extinction is that at which the mean of the colours absorbs as much as was
    drawn: absorption / (1 - single-scattering albedo), at most `DENSE`.
    """
    rng = np.random.default_rng((whole("seed", seed, 0, LARGEST_SEED), 5))
    absorption = np.clip(rng.exponential(), 0.1, 5.0) * settings.absorption
    ior = rng.uniform(1.0, 1.5)
    alpha = single_scattering_albedo(albedo, ior)
    extinction = absorption * settings.size / np.mean(1 - alpha)
    return np.array([min(extinction, DENSE), ior])


def transport(
    lit: Lit,
    position: Float[np.ndarray, "N 3"],
    normal: Float[np.ndarray, "N 3"],
    *,
    paths: int,
    stratified: bool = False,
    seed: int,
) -> ColorEstimate:
    """Indirect irradiance, or radiant exitance where there is a medium."""
    ends, cast = (position, normal), {"paths": paths, "seed": seed}
    if lit.medium.size == 0:
        return indirect_irradiance(lit.scene, *ends, **cast, stratified=stratified)
    extinction, ior = (float(x) for x in lit.medium)
    medium = Medium(lit.albedo[0], extinction, ior)
    known = lit.scene, medium, *ends
    found, lost = subsurface_exitance(*known, **cast, stratified=stratified)
    if lost > MOST_LOST:
        warn(
            f"{lost:.0%} of the walks in the medium left it by holes of the mesh and "
            "count as dark: close them"
        )
    return found


def lit_cloud(source: Source, settings: Illumination | Scattering) -> LitCloud:
    """The lit cloud of a source's scene."""
    return sample_lit(light_up(source, settings), settings, seed=source.seed)


def sample_lit(lit: Lit, settings: Illumination | Scattering, *, seed: int) -> LitCloud:
    """Uniform samples of a scene, the light on them, and what transport makes of it."""
    samples = lit_samples(lit, settings.points, seed)
    cloud = lit_points(lit, samples, settings.looks, seed=seed)
    asked = slice(-(settings.targets or len(cloud.position)), None)
    ends = cloud.position[asked], cloud.normal[asked]
    truth = transport(lit, *ends, paths=settings.paths, seed=seed)
    cloud.target[asked], cloud.variance[asked] = truth
    return cloud


def lit_samples(lit: Lit, count: int, seed: int) -> Samples:
    """Visible samples of a lit scene; of the outside alone of what holds a medium."""
    scene = build_scene(lit.scene.mesh)
    return visible_samples(scene, count, seed, both_sides=lit.medium.size == 0)


def lit_points(lit: Lit, samples: Samples, looks: int, *, seed: int) -> LitCloud:
    """Points of a scene with the direct light on them; their targets are zero."""
    position, normal, material = samples
    irradiance = direct_irradiance(lit.scene, position, normal, looks=looks, seed=seed)
    light = irradiance, np.zeros_like(irradiance), np.zeros_like(irradiance)
    return LitCloud(position, normal, material, *light, lit.albedo, lit.medium)

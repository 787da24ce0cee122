"""From an object to clouds with ground truth, in worker processes, cached on disk."""

import multiprocessing
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ginn_jax.dataset import ShadedPoints, load_cloud, save_cloud
from ginn_jax.errors import InputError
from ginn_jax.irradiance import (
    ColorEstimate,
    LitScene,
    direct_irradiance,
    indirect_irradiance,
    light_scene,
)
from ginn_jax.lit_clouds import Cloud, LitCloud, load_lit_cloud, save_lit_cloud
from ginn_jax.mesh import Mesh, Samples, sample_surface
from ginn_jax.objects import Source, load_light, load_object, origin_of
from ginn_jax.reference import Scene, ambient_occlusion, build_scene
from ginn_jax.subsurface import Medium, subsurface_exitance

# Bounds what a renderer could leak in one process.
SCENES_PER_WORKER = 200
FORMAT = 3
FAR, PROBE_RAYS = 100.0, 32


@dataclass(frozen=True)
class Occlusion:
    """What makes the ground truth: samples, rays per sample, occlusion radius."""

    points: int = 20_000
    rays: int = 64
    radius: float = 0.1


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


@dataclass(frozen=True)
class Scattering:
    """What makes the ground truth of subsurface scattering; `Illumination` has more.

    The object's longest side measures `size` mm, and its medium's extinction is drawn
    from an exponential distribution of mean `extinction` per mm (paper, section
    "Training Data Generation"), kept between 1/10 and 5 times that.
    """

    points: int = 20_000
    paths: int = 32
    looks: int = 128
    targets: int | None = None
    size: float = 100.0
    extinction: float = 0.1


Settings = Occlusion | Illumination | Scattering


def occlusion_cloud(mesh: Mesh, settings: Occlusion, seed: int) -> ShadedPoints:
    """Uniform samples of a scene's visible surface with their ambient occlusion."""
    scene = build_scene(mesh)
    samples = visible_samples(scene, settings.points, seed)
    truth = ambient_occlusion(
        scene,
        samples.position,
        samples.normal,
        settings.radius,
        rays=settings.rays,
        seed=seed,
    )
    return ShadedPoints(samples.position, samples.normal, truth.mean, truth.variance)


def illumination_cloud(source: Source, settings: Illumination) -> LitCloud:
    """Uniform samples with direct and indirect irradiance; materials by the seed."""
    mesh = load_object(source)
    samples = visible_samples(build_scene(mesh), settings.points, source.seed)
    albedo = draw_albedo(source.seed)
    scene = light_scene(mesh, albedo, load_light(source))

    def indirect(position: np.ndarray, normal: np.ndarray) -> ColorEstimate:
        return indirect_irradiance(
            scene, position, normal, paths=settings.paths, seed=source.seed
        )

    return lit_cloud(scene, samples, albedo, np.zeros(0), settings, source, indirect)


def scattering_cloud(source: Source, settings: Scattering) -> LitCloud:
    """Uniform samples of a translucent object with their radiant exitance."""
    mesh = load_object(source, ground=False)
    samples = visible_samples(build_scene(mesh), settings.points, source.seed)
    albedo = draw_albedo(source.seed)[:1]
    medium = draw_medium(source.seed, settings)
    scene = light_scene(mesh, albedo, load_light(source))

    def exitance(position: np.ndarray, normal: np.ndarray) -> ColorEstimate:
        return subsurface_exitance(
            scene,
            Medium(albedo[0], *medium),
            position,
            normal,
            paths=settings.paths,
            seed=source.seed,
        )[0]

    return lit_cloud(
        scene, samples, albedo, np.array(medium), settings, source, exitance
    )


def lit_cloud(
    scene: LitScene,
    samples: Samples,
    albedo: np.ndarray,
    medium: np.ndarray,
    settings: Illumination | Scattering,
    source: Source,
    transport: Callable[[np.ndarray, np.ndarray], ColorEstimate],
) -> LitCloud:
    """Samples with direct irradiance, and what `transport` makes of it at some."""
    position, normal, material = samples
    irradiance = direct_irradiance(
        scene, position, normal, samples=settings.looks, seed=source.seed
    )
    count = len(position) if settings.targets is None else settings.targets
    truth = transport(position[-count:], normal[-count:])
    target, variance = (np.zeros_like(irradiance) for _ in range(2))
    target[-count:], variance[-count:] = truth
    return LitCloud(
        position, normal, material, irradiance, target, variance, albedo, medium
    )


def draw_albedo(seed: int) -> np.ndarray:
    """Uniform RGB albedos of object and ground."""
    return np.random.default_rng((seed, 4)).uniform(0, 1, (2, 3)).astype(np.float32)


def draw_medium(seed: int, settings: Scattering) -> tuple[float, float]:
    """Extinction per length of the object, and index of refraction."""
    rng = np.random.default_rng((seed, 5))
    relative = np.clip(rng.exponential(), 0.1, 5.0)
    return relative * settings.extinction * settings.size, rng.uniform(1.0, 1.5)


def visible_samples(scene: Scene, count: int, seed: int) -> Samples:
    """Uniform samples of the surface that light can reach.

    Meshes of many parts hide surface inside other parts, where no camera can be; it
    would only take points away from what is seen. A sample is dropped if none of
    `PROBE_RAYS` rays from it leaves the scene.

    Raises:
        InputError: a scene that is almost all sealed off.
    """
    drawn = count
    for _ in range(5):
        samples = sample_surface(scene.mesh, drawn, seed=seed)
        sky = ambient_occlusion(
            scene,
            samples.position,
            samples.normal,
            FAR,
            rays=PROBE_RAYS,
            seed=seed,
        )
        seen = np.flatnonzero(sky.mean > 0)
        if len(seen) >= count:
            return Samples(*(a[seen[:count]] for a in samples))
        drawn = 2 * drawn
    raise InputError("nearly all of the mesh's surface is sealed inside it: mend it")


def cloud_origin(source: Source, settings: Settings) -> dict[str, Any]:
    """Everything a cloud depends on; files by their checksums."""
    effect = type(settings).__name__.lower()
    return {"format": FORMAT, "effect": effect, **asdict(settings)} | origin_of(source)


def make_cloud(source: Source, settings: Settings, path: Path) -> None:
    """Make one cloud and write it, unless the file is there and was made like this."""
    origin = cloud_origin(source, settings)
    try:
        read_cloud(source, settings, path)
    except InputError:
        if isinstance(settings, Occlusion):
            mesh = load_object(source)
            save_cloud(path, occlusion_cloud(mesh, settings, source.seed), origin)
        elif isinstance(settings, Illumination):
            save_lit_cloud(path, illumination_cloud(source, settings), origin)
        else:
            save_lit_cloud(path, scattering_cloud(source, settings), origin)


def read_cloud(source: Source, settings: Settings, path: Path) -> Cloud:
    """A cloud from its file; `InputError` where it is not there or another's."""
    origin = cloud_origin(source, settings)
    if isinstance(settings, Occlusion):
        return load_cloud(path, origin)
    return load_lit_cloud(path, origin)


def make_clouds(
    sources: Sequence[Source], settings: Settings, folder: Path, workers: int
) -> Iterator[Path]:
    """Make the clouds of all sources, yielding each path as it is done.

    What `folder` already holds is kept, so a killed run goes on where it was.
    """
    folder.mkdir(parents=True, exist_ok=True)
    jobs = {cloud_path(folder, source): source for source in sources}
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(
        min(workers, max(len(jobs), 1)),
        mp_context=context,
        max_tasks_per_child=SCENES_PER_WORKER,
    ) as pool:
        done = {
            pool.submit(make_cloud, source, settings, path): path
            for path, source in jobs.items()
        }
        try:
            for future in as_completed(done):
                future.result()
                yield done[future]
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def cloud_path(folder: Path, source: Source) -> Path:
    """Where the cloud of a source lies."""
    return folder / f"{source.name}.npz"


def read_clouds(
    sources: Sequence[Source], settings: Settings, folder: Path
) -> list[Any]:
    """The clouds that `make_clouds` made, in the order of the sources."""
    return [read_cloud(s, settings, cloud_path(folder, s)) for s in sources]

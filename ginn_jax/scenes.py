"""From an object to clouds with ground truth, in worker processes, cached on disk."""

import multiprocessing
import warnings
import zlib
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ginn_jax.dataset import ShadedPoints, load_cloud, save_cloud
from ginn_jax.errors import InputError, InputWarning
from ginn_jax.mesh import (
    Mesh,
    Samples,
    add_ground,
    fit_unit_box,
    load_mesh,
    sample_surface,
)
from ginn_jax.reference import Scene, ambient_occlusion, build_scene
from ginn_jax.shapes import random_shape

# Bounds what a renderer could leak in one process.
SCENES_PER_WORKER = 200
FORMAT = 2
FAR, PROBE_RAYS = 100.0, 32


@dataclass(frozen=True)
class Occlusion:
    """What makes the ground truth: samples, rays per sample, occlusion radius."""

    points: int = 20_000
    rays: int = 64
    radius: float = 0.1


@dataclass(frozen=True)
class Source:
    """One object: a mesh file, or the seed of a procedural shape."""

    name: str
    path: str | None
    seed: int


def procedural_sources(count: int, first_seed: int) -> list[Source]:
    """Procedural shapes of consecutive seeds."""
    return [
        Source(f"shape_{s}", None, s) for s in range(first_seed, first_seed + count)
    ]


def file_sources(paths: Sequence[Path]) -> list[Source]:
    """The objects of mesh files."""
    return [Source(path.stem, str(path), i) for i, path in enumerate(paths)]


def load_object(source: Source) -> Mesh:
    """The object in its unit box on the ground."""
    if source.path is None:
        mesh = random_shape(source.seed)
    else:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InputWarning)
            mesh = load_mesh(source.path)
    return add_ground(fit_unit_box(mesh))


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


def cloud_origin(source: Source, settings: Occlusion) -> dict[str, Any]:
    """Everything a cloud depends on; a file's contents by their checksum."""
    origin = {"format": FORMAT, "effect": "ao", **asdict(settings), "seed": source.seed}
    if source.path is None:
        return origin | {"object": source.name}
    try:
        return origin | {"object": zlib.crc32(Path(source.path).read_bytes())}
    except OSError as error:
        raise InputError(f"{source.path}: {error.strerror}") from None


def make_cloud(source: Source, settings: Occlusion, path: Path) -> None:
    """Make one cloud and write it, unless the file is there and was made like this."""
    origin = cloud_origin(source, settings)
    try:
        load_cloud(path, origin)
    except InputError:
        cloud = occlusion_cloud(load_object(source), settings, source.seed)
        save_cloud(path, cloud, origin)


def make_clouds(
    sources: Sequence[Source], settings: Occlusion, folder: Path, workers: int
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
    sources: Sequence[Source], settings: Occlusion, folder: Path
) -> list[ShadedPoints]:
    """The clouds that `make_clouds` made, in the order of the sources."""
    return [
        load_cloud(cloud_path(folder, s), cloud_origin(s, settings)) for s in sources
    ]

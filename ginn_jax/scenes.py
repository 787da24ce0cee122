"""From an object to clouds with ground truth, in worker processes, cached on disk."""

import multiprocessing
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ginn_jax.checks import positive, whole
from ginn_jax.dataset import ShadedPoints, load_cloud, save_cloud
from ginn_jax.errors import InputError, naming
from ginn_jax.lit_clouds import Cloud, load_lit_cloud, save_lit_cloud
from ginn_jax.lit_scenes import Illumination, Scattering, lit_cloud
from ginn_jax.mesh import Mesh
from ginn_jax.objects import Source, load_object, origin_of
from ginn_jax.process import end_with_parent
from ginn_jax.reference import RAYS_PER_LAUNCH, ambient_occlusion, build_scene
from ginn_jax.visible import MOST_SAMPLES, visible_samples

# Bounds what a renderer could leak in one process. Not by `max_tasks_per_child`, with
# which a pool may wait forever for a process that it does not start (python/cpython
# #115634).
SCENES_PER_WORKER = 200
IN_MEMORY = 4 << 30  # bytes
# Raised where an effect's ground truth becomes another, so that what was made is not
# taken for it.
FORMATS = {"occlusion": 5, "illumination": 6, "scattering": 7}


@dataclass(frozen=True)
class Occlusion:
    """What makes the ground truth: samples, rays per sample, occlusion radius."""

    points: int = 20_000
    rays: int = 64
    radius: float = 0.1

    def __post_init__(self) -> None:
        whole("points", self.points, 1, MOST_SAMPLES)
        whole("rays", self.rays, 1, RAYS_PER_LAUNCH)
        positive("radius", self.radius)


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


def cloud_origin(source: Source, settings: Settings) -> dict[str, Any]:
    """Everything a cloud depends on; files by their checksums."""
    effect = type(settings).__name__.lower()
    made = {"format": FORMATS[effect], "effect": effect, **asdict(settings)}
    return made | origin_of(source)


def make_cloud(source: Source, settings: Settings, path: Path) -> None:
    """Make one cloud and write it, unless the file is there and was made like this."""
    origin = cloud_origin(source, settings)
    try:
        read_cloud(source, settings, path)
        return
    except InputError:
        pass
    with naming(source.name):
        if isinstance(settings, Occlusion):
            mesh = load_object(source)
            save_cloud(path, occlusion_cloud(mesh, settings, source.seed), origin)
        else:
            save_lit_cloud(path, lit_cloud(source, settings), origin)


def read_cloud(source: Source, settings: Settings, path: Path) -> Cloud:
    """A cloud from its file; `InputError` where it is not there or another's."""
    origin = cloud_origin(source, settings)
    if isinstance(settings, Occlusion):
        return load_cloud(path, origin)
    return load_lit_cloud(path, origin)


def made_cloud(source: Source, settings: Settings, folder: Path) -> Cloud:
    """A cloud, made unless `folder` already holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    path = cloud_path(folder, source)
    make_cloud(source, settings, path)
    return read_cloud(source, settings, path)


def make_clouds(
    sources: Sequence[Source], settings: Settings, folder: Path, workers: int
) -> Iterator[Path]:
    """Make the clouds of all sources, yielding each path as it is done.

    What `folder` already holds is kept, so a killed run goes on where it was.
    """
    folder.mkdir(parents=True, exist_ok=True)
    by_path: dict[Path, Source] = {}
    for source in sources:
        if by_path.setdefault(cloud_path(folder, source), source) != source:
            raise InputError(f"two objects are called {source.name}: rename the file")
    jobs = list(by_path.items())
    workers = min(workers, max(len(jobs), 1))
    size = workers * SCENES_PER_WORKER
    for first in range(0, len(jobs), size):
        yield from _run_jobs(jobs[first : first + size], settings, workers)


def _run_jobs(
    jobs: Sequence[tuple[Path, Source]], settings: Settings, workers: int
) -> Iterator[Path]:
    """Make these clouds in processes of their own."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, end_with_parent) as pool:
        done = {
            pool.submit(make_cloud, source, settings, path): path
            for path, source in jobs
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


class OnDisk(Sequence[Any]):
    """Clouds that stay in their files, each read whenever it is asked for."""

    def __init__(
        self, sources: Sequence[Source], settings: Settings, folder: Path
    ) -> None:
        self.sources, self.settings, self.folder = sources, settings, folder

    def __len__(self) -> int:
        return len(self.sources)

    def __getitem__(self, index: Any) -> Any:
        source = self.sources[index]
        return read_cloud(source, self.settings, cloud_path(self.folder, source))


def read_clouds(
    sources: Sequence[Source], settings: Settings, folder: Path
) -> Sequence[Any]:
    """The clouds that `make_clouds` made, in the order of the sources; those of a large
    set, as of the paper's 20,000, are not held in memory."""
    clouds = OnDisk(sources, settings, folder)
    if not clouds:
        return []
    each = sum(np.asarray(array).nbytes for array in clouds[0])
    return list(clouds) if each * len(clouds) <= IN_MEMORY else clouds

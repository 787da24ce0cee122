"""Our network with what its samples and its direct light take counted in its time.

Networks are given samples of the surface, the direct light of those and, where
they ask for it, of pixels.
The fewer samples, and the fewer directions that light is looked for in, the less that
takes and the larger the error.
"""

from collections.abc import Iterator, Mapping, Sequence
from functools import partial

import numpy as np
from jaxtyping import Float

from ginn_jax.compare import Shot, Stage, errors
from ginn_jax.compare_networks import OURS, Trained, of_samples
from ginn_jax.compare_pictures import first_samples, network_picture
from ginn_jax.evaluate import Row, at_scale, timed
from ginn_jax.lit_clouds import Cloud, LitCloud
from ginn_jax.lit_scenes import Lit, lit_points, lit_samples
from ginn_jax.lit_views import LitView
from ginn_jax.mesh import Mesh
from ginn_jax.reference import build_scene
from ginn_jax.samples import Samples
from ginn_jax.visible import visible_samples

Seconds = dict[str, float]


def counted_rows(
    stage: Stage,
    cloud: Cloud,
    shot: Shot,
    sharing: Mapping[float, Trained],
    scales: Sequence[float],
    looks: Sequence[int],
    units: Float[np.ndarray, "C"] | None,
    *,
    seed: int,
) -> list[Row]:
    """A row for each share of the samples, number of looks a point, resolution scale.

    `sharing` has our network for each share, with limits that do. `seconds` are those
    of the network, of sampling, of the light of the samples and of that of the pixels.
    The last are not counted where only the display needs them, with any method.
    """
    rows: list[Row] = []
    for share, trained in sharing.items():
        some = first_samples(cloud, share)
        sampling = sampling_seconds(stage, len(some.position), seed=seed)
        asks = trained[0].asks == "all"
        for count, given, seen, lit in looked_at(
            stage, some, shot, looks, asks, seed=seed
        ):
            for scale in scales:
                picture, _ = network_picture(OURS, trained, given, seen, scale)
                parts = lit | {"seconds_sampling": sampling}
                parts |= {"seconds_network": picture.row["seconds"]}
                name = OURS + of_samples(share) + at_scale(scale) + count
                row = {"method": name, "seconds": sum(parts.values())}
                rows.append(row | parts | errors(shot, picture.values, units))
    return rows


def looked_at(
    stage: Stage,
    cloud: Cloud,
    shot: Shot,
    looks: Sequence[int],
    asks: bool,
    *,
    seed: int,
) -> Iterator[tuple[str, Cloud, Shot, Seconds]]:
    """Cloud and, where the network asks for it, shot as each number of looks lights
    them, with its name and what it takes; occlusion, which has no light, as it is."""
    if not isinstance(shot, LitView):
        yield "", cloud, shot, {}
        return
    assert isinstance(stage, Lit)
    assert isinstance(cloud, LitCloud)
    for count in looks:
        given, samples = lit_by(stage, cloud, count, seed=seed)
        pixels, seconds = shot.pixels, 0.0
        if asks:
            pixels, seconds = lit_by(stage, pixels, count, seed=seed)
        spent = {"seconds_samples": samples, "seconds_pixels": seconds}
        yield f", {count} looks", given, shot._replace(pixels=pixels), spent


def sampling_seconds(stage: Stage, count: int, *, seed: int) -> float:
    """What so many samples of a scene's surface take, with those light cannot reach."""
    if isinstance(stage, Mesh):
        return timed(lambda: visible_samples(build_scene(stage), count, seed))[1]
    return timed(lambda: lit_samples(stage, count, seed))[1]


def lit_by(
    stage: Lit, cloud: LitCloud, looks: int, *, seed: int
) -> tuple[LitCloud, float]:
    """Points with their light found by so many looks, and the seconds that took."""
    there = Samples(cloud.position, cloud.normal, cloud.material)
    look = partial(lit_points, stage, there, looks, seed=seed)
    found, seconds = timed(look)
    return cloud._replace(irradiance=found.irradiance), seconds

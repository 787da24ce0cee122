"""Our network with what its samples and its direct light take counted in its time.

Networks are given samples of the surface, the direct light of those and, where
they ask for it, of pixels.
The fewer directions it is looked for in, the less that takes and the noisier it is.
"""

from collections.abc import Sequence
from functools import partial

from ginn_jax.compare import Shot, Stage
from ginn_jax.compare_networks import OURS, Trained, network_picture
from ginn_jax.dataset import ShadedPoints
from ginn_jax.evaluate import Row, timed
from ginn_jax.evaluate_light import LitView
from ginn_jax.lit_clouds import LitCloud
from ginn_jax.lit_scenes import Lit, lit_points, lit_samples
from ginn_jax.mesh import Mesh
from ginn_jax.reference import build_scene
from ginn_jax.samples import Samples
from ginn_jax.visible import visible_samples


def counted_rows(
    stage: Stage,
    cloud: ShadedPoints | LitCloud,
    shot: Shot,
    trained: Trained,
    looks: Sequence[int],
    sampling: float,
    *,
    seed: int,
) -> tuple[list[Row], Trained]:
    """A row for each number of looks a point, and the network with the limits it took.

    `seconds` are those of the network, of `sampling`, of the light of the samples and
    of that of the pixels. The last are not counted where only the display needs them,
    with any method.
    None for occlusion, which has no light.
    """
    rows: list[Row] = []
    if not isinstance(shot, LitView):
        return rows, trained
    assert isinstance(stage, Lit)
    assert isinstance(cloud, LitCloud)
    asks = trained[0].asks == "all"
    for count in looks:
        given, samples = looked_at(stage, cloud, count, seed=seed)
        seen, pixels = shot, 0.0
        if asks:
            lit, pixels = looked_at(stage, shot.pixels, count, seed=seed)
            seen = shot._replace(pixels=lit)
        name = f"{OURS}, {count} looks"
        picture, trained = network_picture(name, trained, given, seen)
        parts = {"seconds_samples": samples, "seconds_pixels": pixels}
        parts |= {"seconds_network": picture.row["seconds"]}
        parts |= {"seconds_sampling": sampling}
        whole = {"looks": count, "seconds": sum(parts.values())}
        rows.append(picture.row | parts | whole)
    return rows, trained


def sampling_seconds(stage: Stage, count: int, *, seed: int) -> float:
    """What so many samples of a scene's surface take, with those light cannot reach."""
    if isinstance(stage, Mesh):
        return timed(lambda: visible_samples(build_scene(stage), count, seed))[1]
    return timed(lambda: lit_samples(stage, count, seed))[1]


def looked_at(
    stage: Lit, cloud: LitCloud, looks: int, *, seed: int
) -> tuple[LitCloud, float]:
    """Points with their light found by so many looks, and the seconds that took."""
    there = Samples(cloud.position, cloud.normal, cloud.material)
    look = partial(lit_points, stage, there, looks, seed=seed)
    found, seconds = timed(look)
    return cloud._replace(irradiance=found.irradiance), seconds

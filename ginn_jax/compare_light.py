"""Our network with what its direct light takes counted in its time.

Networks are given the direct light of samples and, where they ask for it, of pixels.
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
from ginn_jax.lit_scenes import Lit, lit_points
from ginn_jax.samples import Samples


def counted_rows(
    stage: Stage,
    cloud: ShadedPoints | LitCloud,
    shot: Shot,
    trained: Trained,
    looks: Sequence[int],
    *,
    seed: int,
) -> tuple[list[Row], Trained]:
    """A row for each number of looks a point, and the network with the limits it took.

    `seconds` are those of the network, of the light of the samples and of that of the
    pixels. The last are not counted where only the display needs them, with any method.
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
        whole = {"looks": count, "seconds": sum(parts.values())}
        rows.append(picture.row | parts | whole)
    return rows, trained


def looked_at(
    stage: Lit, cloud: LitCloud, looks: int, *, seed: int
) -> tuple[LitCloud, float]:
    """Points with their light found by so many looks, and the seconds that took."""
    there = Samples(cloud.position, cloud.normal, cloud.material)
    look = partial(lit_points, stage, there, looks, seed=seed)
    found, _, seconds = timed(look, repeats=1)
    return cloud._replace(irradiance=found.irradiance), seconds

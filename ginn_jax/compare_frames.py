"""Networks on the frames of an animation: their values, and what their levels keep."""

from typing import Any, NamedTuple

from jaxtyping import Bool

from ginn_jax.compare import Shot, Values
from ginn_jax.compare_networks import Trained, redrawn
from ginn_jax.dataset import ShadedPoints
from ginn_jax.image import within_range
from ginn_jax.inference import encode_cloud, nothing_kept, shade_points
from ginn_jax.lit_clouds import LitCloud, network_numbers
from ginn_jax.lit_views import LitView, channels_of, encode_lit


class Playing(NamedTuple):
    """A network between two frames: each draw of its Poisson disks, and the samples
    that its levels kept of the frame before."""

    draws: list[Trained]
    kept: list[Bool[Any, "L R"]]


def start_playing(trained: Trained, draws: int, points: int) -> Playing:
    """A network before the first frame of a cloud of so many points."""
    network = trained[0]
    several = [trained, *redrawn(trained, draws)]
    return Playing(several, [nothing_kept(network, points)] * draws)


def shade_next(
    playing: Playing, cloud: ShadedPoints | LitCloud, shot: Shot
) -> tuple[list[Values], Playing]:
    """What each draw makes of the pixels of the next frame, not timed."""
    values, draws, kept = [], [], []
    limits = playing.draws[0][1]
    for (network, _, model), before in zip(*playing, strict=True):
        found, limits, after = _values((network, limits, model), cloud, shot, before)
        values.append(found)
        kept.append(after)
    draws = [(network, limits, model) for network, _, model in playing.draws]
    return values, Playing(draws, kept)


def _values(
    trained: Trained,
    cloud: ShadedPoints | LitCloud,
    shot: Shot,
    kept_before: Bool[Any, "L R"],
) -> tuple[Values, Any, Any]:
    """Values at the pixels, limits, and the samples that levels kept."""
    network, limits, model = trained
    numbers: Any = ()
    if isinstance(cloud, ShadedPoints):
        ends = model.variables, cloud.position, cloud.normal
        encoded, limits = encode_cloud(
            network, limits, *ends, kept_before=kept_before, key=model.key
        )
    else:
        assert isinstance(shot, LitView)
        ends = network, limits, model, cloud, kept_before
        encoded, limits = encode_lit(*ends, merge_grey=True)
        numbers = network_numbers(shot.pixels, channels_of(encoded))
    mask = shot.gbuffer.mask
    pixels = shot.gbuffer.position[mask], shot.gbuffer.normal[mask]
    given = network, limits, model.variables, encoded, *pixels
    values, limits = shade_points(*given, *numbers)
    return within_range(encoded, values), limits, encoded.kept

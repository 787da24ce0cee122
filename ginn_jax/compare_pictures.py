"""What networks make of the shots of a comparison: pictures, 3D errors, memory."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from ginn_jax import evaluate, evaluate_light, lit_views
from ginn_jax.block_shading import shade_turn
from ginn_jax.blocks import Turn, largest_block, turn_shapes
from ginn_jax.compare import Picture, Shot, errors, of_variance, scratch_mib
from ginn_jax.compare_networks import (
    ABLATIONS,
    NETWORKS,
    OURS,
    Trained,
    of_samples,
    redrawn,
)
from ginn_jax.dataset import count_given
from ginn_jax.evaluate import Row, View, at_scale
from ginn_jax.inference import encode_cloud, encode_whole
from ginn_jax.lane_encoding import encodes_in_lanes
from ginn_jax.lane_shading import lanes_for
from ginn_jax.lanes import most_held_mib
from ginn_jax.limits import only, without
from ginn_jax.lit_clouds import Cloud, LitCloud, mean_light, points_of, split_points
from ginn_jax.neighbors import bucket
from ginn_jax.objects import Source
from ginn_jax.process import on_cpu, spare_memory_maps
from ginn_jax.receptive_field import Oriented
from ginn_jax.scenes import Occlusion, Settings
from ginn_jax.shading import Encoded


def points_given(cloud: Any) -> tuple[Any, np.ndarray | None]:
    """The part of a cloud that networks are given, and the units of its light."""
    if not isinstance(cloud, LitCloud):
        return evaluate.split_cloud(cloud)[0], None
    given = split_points(cloud, count_given(len(cloud.position)))[0]
    return given, mean_light(given)


def first_samples(cloud: Cloud, share: float) -> Cloud:
    """A share of a cloud, whose samples are in no order: the first, at least one."""
    count = max(int(share * len(cloud.position)), 1)
    return points_of(cloud, slice(count))


def errors_at_points(
    networks: dict[str, Trained],
    clouds: Sequence[Any],
    sources: list[Source],
    settings: Settings,
) -> tuple[dict[str, Row], dict[str, Trained]]:
    """3D errors of every network, and the networks with the limits they took."""
    found = {}
    for name, trained in networks.items():
        rows, networks[name] = rows_at_points(trained, clouds, sources, settings)
        found[name] = evaluate.pool_rows(rows)
    return found, networks


def rows_at_points(
    trained: Trained, clouds: Sequence[Any], sources: list[Source], settings: Settings
) -> tuple[list[Row], Trained]:
    """3D errors on every cloud, and the network with the limits it took."""
    network, limits, model = trained
    given = network, limits, model, clouds, [s.name for s in sources]
    if isinstance(settings, Occlusion):
        rows, limits = evaluate.evaluate_clouds(*given, settings.rays)
    else:
        rows, limits = evaluate_light.evaluate_lit_clouds(*given, settings)
    return rows, (network, limits, model)


def network_picture(
    name: str,
    trained: Trained,
    cloud: Cloud,
    shot: Shot,
    scale: float = 1.0,
) -> tuple[Picture, Trained]:
    """A network's picture, and the network with the limits that it took."""
    spare_memory_maps()  # every shot and network compiles programs of its own
    network, limits, model = trained
    given = network, limits, model, cloud, shot, scale
    if isinstance(shot, View):
        row, image, limits = evaluate.network_row(*given)  # type: ignore[arg-type]
        values = image[shot.gbuffer.mask]
    else:
        row, values, _, limits = evaluate_light.lit_network_row(*given)  # type: ignore[arg-type]
    row |= {"method": name} | of_variance(shot, row)
    return Picture(row, values), (network, limits, model)


def network_pictures(
    networks: Mapping[str, Trained], cloud: Cloud, shot: Shot
) -> tuple[list[Picture], dict[str, Trained]]:
    """Pictures of ours and of the ablations, and all with the limits they took."""
    pictures, networks = [], dict(networks)
    for name in NETWORKS:
        picture, networks[name] = network_picture(name, networks[name], cloud, shot)
        pictures.append(picture)
    return pictures, networks


def variant_rows(
    networks: Mapping[str, Trained],
    cloud: Cloud,
    shot: Shot,
    shares: Sequence[float],
    scales: Sequence[float],
    units: Float[np.ndarray, "C"] | None,
) -> tuple[list[Row], dict[str, Trained]]:
    """Our network at each rate on each share of the samples, all of which at full rate
    left out, and other networks but the ablations; and all with the limits they took.

    `networks` has ours by the share too.
    """
    rows, networks = [], dict(networks)
    sharing = {OURS + of_samples(share): share for share in shares}
    for name in [name for name in networks if name not in ABLATIONS]:
        some = first_samples(cloud, sharing.get(name, 1.0))
        for scale in scales if name in sharing else (1.0,):
            if (called := name + at_scale(scale)) == OURS:
                continue
            ends = networks[name], some, shot, scale
            picture, networks[name] = network_picture(called, *ends)
            rows.append(picture.row | errors(shot, picture.values, units))
    return rows, networks


def mean_picture(
    own: Picture,
    trained: Trained,
    cloud: Cloud,
    shot: Shot,
    draws: int,
    units: Float[np.ndarray, "C"] | None,
) -> Picture:
    """The mean of our network's own picture and those of other draws of the Poisson
    disks, which costs the time of all."""
    others = redrawn(trained, draws)
    pictures = [own, *(network_picture(OURS, t, cloud, shot)[0] for t in others)]
    values = np.mean([p.values for p in pictures], axis=0)
    parts = "seconds_3d", "seconds_2d", "seconds"
    times = {part: sum(p.row[part] for p in pictures) for part in parts}
    row = {"method": f"{OURS}, mean of {draws}"} | times | errors(shot, values, units)
    return Picture(row, values)


def codes_kept(row: Row) -> Row:
    """A network's row where the codes of f_3D are at hand: only the camera has moved
    since, neither the scene nor its light."""
    name = f"{row['method']}, codes kept"
    return row | {"method": name, "seconds": row["seconds_2d"], "kept": 1}


def _encode(trained: Trained, cloud: Cloud) -> Encoded:
    """f_3D of a cloud."""
    network, limits, model = trained
    if isinstance(cloud, LitCloud):
        given = network, limits, model, cloud
        return lit_views.encode_lit(*given, merge_grey=True)[0]
    ends = model.variables, cloud.position, cloud.normal
    return encode_cloud(network, limits, *ends, key=model.key)[0]


def network_memory(trained: Trained, cloud: Cloud) -> float:
    """Memory in MiB that f_3D of a cloud and f_2D take beside inputs and outputs; what
    f_3D hands to f_2D is counted.

    By JAX it is what programs ask for, f_2D's on a block on every device. In lanes it
    is the most that f_3D holds at a time (but for large layers of rows, JAX's);
    f_2D keeps little more than a copy of what it is handed.
    """
    network, limits, model = trained
    points = len(cloud.position)

    def shapes(rows: int, asked: bool) -> Any:
        place = jax.ShapeDtypeStruct((rows, 3), np.float32)
        ends = Oriented(place, place, jax.ShapeDtypeStruct((rows,), bool))
        widths = (network.materials, network.lights) if asked else (0, 0)
        numbers = (
            jax.ShapeDtypeStruct((3, rows, width), np.float32) if width else None
            for width in widths
        )
        return ends, *numbers

    deep = network, without(limits, network.query.name)
    given = model.variables, *shapes(bucket(points), True), None, model.key
    encoded, _ = jax.eval_shape(partial(encode_whole, *deep), *given)
    kept = sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(encoded.code)) / 2**20
    if encodes_in_lanes(network):
        held = most_held_mib(lambda: _encode(trained, cloud))
    else:
        held = scratch_mib(encode_whole.lower(*deep, *given).compile())
    if lanes_for(network):
        return held + kept
    flat = network, only(limits, network.query.name), on_cpu(), model.variables
    rows = largest_block(encoded.scale is not None)
    turn = turn_shapes(Turn(*shapes(rows, network.asks == "all")))
    shaded = shade_turn.lower(*flat, encoded, turn).compile()
    blocks = len(jax.devices()) * scratch_mib(shaded)
    return max(held, blocks) + kept

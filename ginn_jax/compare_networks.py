"""Our network and its ablations in a comparison: pictures, 3D errors, memory."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from ginn_jax import evaluate, evaluate_light
from ginn_jax.architecture import Network
from ginn_jax.blocks import Turn, largest_block, turn_shapes
from ginn_jax.compare import Picture, Shot, errors, of_variance, scratch_mib
from ginn_jax.dataset import ShadedPoints, count_given
from ginn_jax.disk_radius import limits_at, with_disk_radius
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model, Row, View
from ginn_jax.inference import encode_whole, shade_turn
from ginn_jax.limits import Limits, only, without
from ginn_jax.lit_clouds import LitCloud, mean_light, split_points
from ginn_jax.neighbors import bucket
from ginn_jax.objects import Source
from ginn_jax.pretrained import load_manifest, load_network
from ginn_jax.process import spare_memory_maps
from ginn_jax.receptive_field import Oriented
from ginn_jax.run_record import RECORD, damaged, read_record
from ginn_jax.scenes import Occlusion, Settings

Trained = tuple[Network, Limits, Model]

OURS = "ours"
OTHER = "run "
NETWORKS = {OURS: "", "2D only": "_only_2d", "3D only": "_only_3d"}


def load_networks(
    effect: str,
    settings: Settings,
    runs: Sequence[Path | None],
    *,
    key: Key[Array, ""],
) -> dict[str, Trained]:
    """Our network of an effect and its ablations, of finished runs or, for None, those
    that come with the package.

    Raises:
        InputError: a network of another occlusion radius than that of `settings`.
    """
    return {
        name: load_trained(effect + ending, settings, run, key=key)
        for (name, ending), run in zip(NETWORKS.items(), runs, strict=True)
    }


def load_trained(
    name: str, settings: Settings, run: Path | None, *, key: Key[Array, ""]
) -> Trained:
    """The network of a finished run or, for None, the package's of that name.

    Raises:
        InputError: as `load_networks`.
    """
    config, limits, weights = load_network(name, run)
    if isinstance(settings, Occlusion):
        check_radius(name, learned_from(name, run), settings.radius)
    return config.network, limits, Model(weights, key)


def at_disk_radius(trained: Trained, radius: float) -> Trained:
    """The same network on a finest level of another Poisson disk radius."""
    network, limits, model = trained
    variant = with_disk_radius(network, radius)
    return variant, limits_at(network, limits, radius), model


def disk_variants(trained: Trained, disks: Sequence[float]) -> dict[str, Trained]:
    """A network on finest levels of other Poisson disk radii, times that of its own."""
    radii = [times * trained[0].levels[0] for times in disks]
    return {f"{OURS}, disk {r:.3g}": at_disk_radius(trained, r) for r in radii}


def redrawn(trained: Trained, draws: int) -> list[Trained]:
    """The same network on other draws of the Poisson disks, so many with its own."""
    network, limits, (variables, key) = trained
    keys = [jax.random.fold_in(key, n) for n in range(1, draws)]
    return [(network, limits, Model(variables, key)) for key in keys]


def learned_from(name: str, run: Path | None) -> dict[str, Any]:
    """What made the targets that a network learned from."""
    if run is None:
        return load_manifest()[name]["data"]
    path = run / RECORD
    with damaged(path, "train again"):
        return dict(read_record(path, "no run: name the --out of one")["data"])


def check_radius(name: str, data: dict[str, Any], radius: float) -> None:
    """Raise `InputError` unless a network learned occlusion within this radius."""
    if data.get("radius") != radius:
        raise InputError(
            f"{name} learned occlusion within {data.get('radius')}, not within "
            f"{radius}: give that as --radius, or train another"
        )


def other_runs(
    effect: str, settings: Settings, runs: Sequence[Path], *, key: Key[Array, ""]
) -> dict[str, Trained]:
    """Networks of other finished runs of an effect, by the names of their folders.

    Raises:
        InputError: as `load_networks`, or two folders of one name.
    """
    names = [f"{OTHER}{run.resolve().name}" for run in runs]
    if len(set(names)) < len(names):
        raise InputError("two of the runs beside have one name: rename a folder")
    found = (load_trained(effect, settings, run, key=key) for run in runs)
    return dict(zip(names, found, strict=True))


def points_given(cloud: Any) -> tuple[Any, np.ndarray | None]:
    """The part of a cloud that networks are given, and the units of its light."""
    if not isinstance(cloud, LitCloud):
        return evaluate.split_cloud(cloud)[0], None
    given = split_points(cloud, count_given(len(cloud.position)))[0]
    return given, mean_light(given)


def errors_at_points(
    networks: dict[str, Trained],
    clouds: list[Any],
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
    trained: Trained, clouds: list[Any], sources: list[Source], settings: Settings
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
    cloud: ShadedPoints | LitCloud,
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


def mean_picture(
    own: Picture,
    trained: Trained,
    cloud: ShadedPoints | LitCloud,
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


def network_memory(trained: Trained, points: int) -> float:
    """Scratch memory of f_3D on so many points and of f_2D on a block on every device.

    What f_3D hands to f_2D is counted, inputs and outputs are not.
    """
    network, limits, model = trained

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
    compiled = encode_whole.lower(*deep, *given).compile()
    encoded, _ = jax.eval_shape(partial(encode_whole, *deep), *given)
    kept = sum(a.size * a.dtype.itemsize for a in jax.tree.leaves(encoded.code))
    flat = network, only(limits, network.query.name), True, model.variables
    rows = largest_block(encoded.scale is not None)
    turn = turn_shapes(Turn(*shapes(rows, network.asks == "all")))
    shaded = shade_turn.lower(*flat, encoded, turn).compile()
    blocks = len(jax.devices()) * scratch_mib(shaded)
    return max(scratch_mib(compiled), blocks) + kept / 2**20

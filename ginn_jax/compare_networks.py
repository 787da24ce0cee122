"""The networks of a comparison: ours, its ablations and variants, other runs."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jaxtyping import Array, Key

from ginn_jax.architecture import Network
from ginn_jax.disk_radius import limits_at, with_disk_radius
from ginn_jax.errors import InputError
from ginn_jax.evaluate import Model
from ginn_jax.limits import Limits
from ginn_jax.pretrained import load_manifest, load_network, run_folder
from ginn_jax.run_record import RECORD, damaged, read_record
from ginn_jax.scenes import Occlusion, Settings

LOG = logging.getLogger("ginn_jax")

Trained = tuple[Network, Limits, Model]

OURS = "ours"
OTHER = "run "
ABLATIONS = {"2D only": "_only_2d", "3D only": "_only_3d"}
NETWORKS = {OURS: "", **ABLATIONS}


def load_networks(
    effect: str,
    settings: Settings,
    names: Sequence[str | None],
    *,
    key: Key[Array, ""],
) -> dict[str, Trained]:
    """Our network of an effect and its ablations, as `load_trained`; for None those of
    the package that were trained alike.

    Raises:
        InputError: as `load_trained`.
    """
    return {
        method: load_trained(effect, settings, name or effect + ending, key=key)
        for (method, ending), name in zip(NETWORKS.items(), names, strict=True)
    }


def load_trained(
    effect: str, settings: Settings, name: str | None, *, key: Key[Array, ""]
) -> Trained:
    """The network of a finished run, if its folder is named, or of the package; for
    None the package's that is named as the effect.

    Raises:
        InputError: a network of another effect, or one of another occlusion radius
            than that of `settings`.
    """
    name = name or effect
    config, limits, weights = load_network(effect, name)
    if isinstance(settings, Occlusion):
        check_radius(name, learned_from(name), settings.radius)
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


def learned_from(name: str) -> dict[str, Any]:
    """What made the targets that a network learned from."""
    run = run_folder(name)
    if run is None:
        return load_manifest()[name]["data"]
    record = _record(run)
    with damaged(run / RECORD, "train again"):
        return dict(record["data"])


def warn_of_seen(names: Sequence[str | None], scenes: Sequence[str]) -> None:
    """Say of each run that is named which of these scenes have an object or a light by
    whose name it trained on one."""
    for run in filter(None, map(run_folder, filter(None, names))):
        record = _record(run)
        with damaged(run / RECORD, "train again"):
            seen = _parts(record.get("objects", []))
        if found := sorted(_parts(scenes) & seen):
            LOG.warning(
                "%s trained on what is called %s: its errors may be of scenes it has "
                "seen",
                run,
                ", ".join(found),
            )


def _record(run: Path) -> Any:
    return read_record(run / RECORD, "no run: name the --out of one")


def _parts(scenes: Sequence[str]) -> set[str]:
    """The names of the objects and of the lights of scenes."""
    return {part for name in scenes for part in name.split("__")}


def check_radius(name: str, data: dict[str, Any], radius: float) -> None:
    """Raise `InputError` unless a network learned occlusion within this radius."""
    if data.get("radius") != radius:
        raise InputError(
            f"{name} learned occlusion within {data.get('radius')}, not within "
            f"{radius}: give that as --radius, or train another"
        )


def others_beside(
    effect: str, settings: Settings, names: Sequence[str], *, key: Key[Array, ""]
) -> dict[str, Trained]:
    """Other networks of an effect by the names of their folders or their own.

    Raises:
        InputError: as `load_trained`, or two of one name.
    """
    labels = [f"{OTHER}{Path(name).resolve().name}" for name in names]
    if len(set(labels)) < len(labels):
        raise InputError("two of the runs beside have one name: rename a folder")
    return {
        label: load_trained(effect, settings, name, key=key)
        for label, name in zip(labels, names, strict=True)
    }


def of_samples(share: float) -> str:
    """What the name of a method says of a share of the samples."""
    return f", {share:.3g} of samples" if share < 1 else ""
